"""Pictures of coloured meshes, drawn off-screen by VTK."""

from __future__ import annotations

import os
import signal
import sys
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np

from meshspiral.geometry.mesh import Mesh

VIEWS = ("front", "back")


class RenderError(RuntimeError):
    """There is no picture; the message says what is missing."""


class Row(NamedTuple):
    """Meshes side by side, each with its colours, float [V, 3] in 0..1."""

    meshes: list[Mesh]
    colors: list[np.ndarray]


class Picture(NamedTuple):
    """A row on white: for each view an image, uint8 [640, W, 3]; and where the middle of each mesh
    is in all of them, as a share of the width."""

    images: list[np.ndarray]
    middles: np.ndarray


def render(rows: list[Row], up: str, views: tuple[str, ...] = VIEWS) -> list[Picture]:
    """up: the axis that points up, "y" (the front is then +z) or "z" (-y).

    No display is needed, but an OpenGL library is. Errors: RenderError without one.
    """
    # VTK ends the whole process where it finds no OpenGL: so it has one of its own
    context, ignore = get_context("spawn"), (signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for ours
    with ProcessPoolExecutor(1, context, initializer=signal.signal, initargs=ignore) as process:
        try:
            return process.submit(_render, rows, up, views).result()
        except (BrokenProcessPool, ImportError) as error:
            raise RenderError(
                "VTK could not draw; it needs an OpenGL library (on Debian: libegl1, libgl1)"
            ) from error


def upright(vertices: np.ndarray, up: str, view: str = "front") -> np.ndarray:
    """float64 [V, 3]: turned so that y is up and z comes towards who looks at that view."""
    x, y, z = vertices.astype(np.float64).T
    if up == "z":
        y, z = z, -y
    return np.stack([-x, y, -z] if view == "back" else [x, y, z], axis=1)


def _render(rows, up, views):
    return [_render_row(*row, up, views) for row in rows]


def _render_row(meshes, colors, up, views):
    if sys.platform == "linux" and "DISPLAY" not in os.environ:
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    import pyvista  # takes seconds

    sizes = [np.ptp(upright(mesh.vertices, up), axis=0) for mesh in meshes]
    tall = max(max(size[1], 0.05 * size[0]) for size in sizes)  # of a flat one, a line
    gap = 0.08 * tall
    middles, left = [], gap
    for size in sizes:
        middles.append(left + size[0] / 2)
        left += size[0] + gap
    width, height = left, 1.08 * tall
    images = []
    for view in views:
        plotter = pyvista.Plotter(off_screen=True, window_size=(int(640 * width / height), 640))
        plotter.set_background("white")
        for mesh, color, middle in zip(meshes, colors, middles, strict=True):
            points = upright(mesh.vertices, up, view)
            points += [middle, 0, 0] - (points.min(axis=0) + points.max(axis=0)) / 2
            surface = pyvista.make_tri_mesh(points, mesh.faces)
            plotter.add_mesh(
                surface,
                scalars=np.round(255 * color).astype(np.uint8),
                rgb=True,
                smooth_shading=True,
                ambient=0.25,
            )
        plotter.view_xy()
        plotter.enable_parallel_projection()
        plotter.camera.focal_point = (width / 2, 0, 0)
        plotter.camera.position = (width / 2, 0, 10 * tall)
        plotter.camera.parallel_scale = height / 2
        plotter.reset_camera_clipping_range()
        images.append(np.asarray(plotter.screenshot(return_img=True)))
        plotter.close()
    return Picture(images, np.array(middles) / width)
