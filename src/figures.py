"""Curves and pictures."""

from __future__ import annotations

import os
import sys
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from src.geometry.mesh import Mesh


class RenderError(RuntimeError):
    """There is no picture; the message says what is missing."""


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


def growth_figure(series: list[dict]) -> Figure:
    """Seconds and megabytes of a pass over its sizes, both axes logarithmic.

    series: as `src.growth.growth` gives them. Dashed: what is proportional to the size.
    """
    overs, units = list(dict.fromkeys(row["over"] for row in series)), ("seconds", "MB")
    figure = Figure(figsize=(3.4 * len(overs), 5.6), layout="constrained")
    axes = figure.subplots(2, len(overs), squeeze=False)
    for column, over in enumerate(overs):
        for unit, ax in zip(units, axes[:, column], strict=True):
            for row in series:
                if row["over"] == over and None not in row[unit]:
                    label = f"{row['what']}, {row[f'exponent of {unit}']:.2f}"
                    [line] = ax.loglog(row["sizes"], row[unit], "o-", ms=3, lw=1.4, label=label)
                    end = row[unit][-1] / row["sizes"][-1]
                    ax.loglog(row["sizes"], [end * size for size in row["sizes"]], "--", lw=0.8,
                              color=line.get_color())  # fmt: skip
            ax.set(xlabel=over, ylabel=unit)
            ax.grid(alpha=0.3)
            ax.legend(fontsize="small", title="exponent", title_fontsize="small")
    return figure


def template_colors(template: Mesh) -> np.ndarray:
    """float [K, 3] in 0..1: a colour for each template vertex, from its place in the bounding box.

    Equal colours on two shapes mean: the same place of the template.
    """
    low, high = template.vertices.min(axis=0), template.vertices.max(axis=0)
    return 0.1 + 0.9 * (template.vertices - low) / np.maximum(high - low, 1e-12)


def render_row(
    path: str | Path, meshes: list[Mesh], colors: list[np.ndarray], captions: list[str], up: str
) -> None:
    """Write a PNG of meshes side by side, as seen from the front.

    colors: for each mesh [V, 3] in 0..1. up: the axis that points up, "y" (the front is then +z) or
    "z" (-y). No display is needed, but an OpenGL library is. Errors: RenderError without one.
    """
    # VTK ends the whole process where it finds no OpenGL: so it has one of its own
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        try:
            process.submit(_render_row, path, meshes, colors, captions, up).result()
        except (BrokenProcessPool, ImportError) as error:
            raise RenderError(
                "VTK could not draw; it needs an OpenGL library (on Debian: libegl1, libgl1)"
            ) from error


def _render_row(path, meshes, colors, captions, up) -> None:
    if sys.platform == "linux" and "DISPLAY" not in os.environ:
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    import pyvista  # takes seconds

    axes = {"y": (0, 1, 2), "z": (0, 2, 1)}[up]
    placed, left = [], 0.0
    for mesh in meshes:
        points = mesh.vertices[:, axes] * ([1, 1, -1] if up == "z" else [1, 1, 1])
        low, high = points.min(axis=0), points.max(axis=0)
        points = points - [low[0] - left, (low[1] + high[1]) / 2, (low[2] + high[2]) / 2]
        left = points[:, 0].max()
        placed.append(points)
    tall = max(np.ptp(points[:, 1]) for points in placed)
    gap = 0.08 * tall
    width, height = left + gap * (len(meshes) + 1), 1.2 * tall
    plotter = pyvista.Plotter(off_screen=True, window_size=(int(640 * width / height), 640))
    plotter.set_background("white")
    for i, (points, mesh, color) in enumerate(zip(placed, meshes, colors, strict=True)):
        points[:, 0] += gap * (i + 1)
        surface = pyvista.make_tri_mesh(points, mesh.faces)
        plotter.add_mesh(surface, scalars=np.round(255 * color).astype(np.uint8), rgb=True,
                         smooth_shading=True, ambient=0.25)  # fmt: skip
    below = [[(p[:, 0].min() + p[:, 0].max()) / 2, -0.57 * tall, 0] for p in placed]
    plotter.add_point_labels(np.array(below), captions, shape=None, show_points=False,
                             text_color="black", font_size=18, bold=False, always_visible=True,
                             justification_horizontal="center")  # fmt: skip
    plotter.view_xy()
    plotter.enable_parallel_projection()
    plotter.camera.focal_point = (width / 2, 0, 0)
    plotter.camera.position = (width / 2, 0, 10 * tall)
    plotter.camera.parallel_scale = height / 2
    plotter.reset_camera_clipping_range()
    plotter.screenshot(str(path))
    plotter.close()
