"""Curves and pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from src.geometry.mesh import Mesh


def curve_figure(curves: dict[str, tuple[np.ndarray, np.ndarray]]) -> Figure:
    """The share of correct matches over the geodesic error (Kim et al. 2011).

    curves: by name, thresholds [T] over sqrt(area) and shares [T] in 0..1. The figure belongs to no
    window system: save it with `figure.savefig(path)`.
    """
    figure = Figure(figsize=(4.8, 3.6), layout="constrained")
    axes = figure.add_subplot()
    for name, (thresholds, shares) in curves.items():
        axes.plot(thresholds, 100 * shares, label=name, linewidth=1.8)
    axes.set(xlabel=r"geodesic error / $\sqrt{\mathrm{area}}$", ylabel="correct matches (%)",
             xlim=(0, thresholds[-1]), ylim=(0, 100))  # fmt: skip
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    return figure


def template_colors(template: Mesh) -> np.ndarray:
    """float [K, 3] in 0..1: a colour for each template vertex, from its place in the bounding box.

    Equal colours on two shapes mean: the same place of the template.
    """
    low, high = template.vertices.min(axis=0), template.vertices.max(axis=0)
    place = (template.vertices - low) / np.maximum(high - low, 1e-12)
    return 0.15 + 0.8 * place


def render_row(
    path: str | Path, meshes: list[Mesh], colors: list[np.ndarray], captions: list[str]
) -> None:
    """Write a PNG of meshes side by side, seen along the axis of their least extent.

    colors: for each mesh [V, 3] in 0..1. Nothing is shown on a screen; no display is needed.
    """
    import pyvista  # starts VTK, which takes seconds: only for who wants a picture

    plotter = pyvista.Plotter(off_screen=True, window_size=(300 * len(meshes), 520))
    plotter.set_background("white")
    height = max(np.ptp(mesh.vertices, axis=0).max() for mesh in meshes)
    points = []
    for i, (mesh, color, caption) in enumerate(zip(meshes, colors, captions, strict=True)):
        middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
        vertices = mesh.vertices - middle + [0.75 * height * i, 0.0, 0.0]
        surface = pyvista.make_tri_mesh(vertices, mesh.faces)
        plotter.add_mesh(surface, scalars=np.round(255 * color).astype(np.uint8), rgb=True,
                         smooth_shading=True)  # fmt: skip
        points.append([0.75 * height * i, 0.0, -0.58 * height])
        del caption
    plotter.add_point_labels(np.array(points), captions, shape=None, show_points=False,
                             text_color="black", font_size=16, justification_horizontal="center",
                             always_visible=True)  # fmt: skip
    plotter.camera_position = "xz"
    plotter.enable_parallel_projection()
    plotter.screenshot(str(path))
    plotter.close()
