"""Renders of coloured meshes, off-screen, by VTK."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from meshspiral.geometry.mesh import Mesh

VIEWS = ("front", "back")
# of the process that renders; two files are its last words: the request and the answer
COMMAND = [sys.executable, "-c", "from meshspiral.viz.render import answer; answer()"]


class RenderError(RuntimeError):
    """Nothing could be rendered; the message says what is missing."""


class Row(NamedTuple):
    """Meshes to show side by side.

    Attributes:
        meshes: The meshes.
        colors: The colours of each mesh's vertices, float [V, 3] in 0..1.
    """

    meshes: list[Mesh]
    colors: list[np.ndarray]


class Picture(NamedTuple):
    """The render of a row.

    Attributes:
        images: For each view an image with a white background, uint8 [640, W, 3].
        middles: Horizontal position of each mesh's centre over the width of an image, float64 [M].
    """

    images: list[np.ndarray]
    middles: np.ndarray


def render(rows: list[Row], up: str, views: tuple[str, ...] = VIEWS) -> list[Picture]:
    """Render rows of meshes. Needs an OpenGL library, but no display.

    Args:
        rows: What to show.
        up: The axis that points up: "y", and the front faces +z; or "z", and the front faces -y.
        views: "front" and "back", or one of them.

    Returns:
        A picture for each row.

    Raises:
        RenderError: VTK finds no OpenGL library.
    """
    # Without OpenGL, VTK crashes its process, so it gets one of its own: a plain one, since
    # multiprocessing's does not start within the workers of other pools. Ctrl-C does not reach it.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with tempfile.TemporaryDirectory() as folder:
        request, result = Path(folder, "request"), Path(folder, "result")
        request.write_bytes(pickle.dumps((rows, up, views)))
        process = subprocess.run(
            [*COMMAND, request, result],
            env=environment,
            capture_output=True,
            start_new_session=True,
            check=False,
        )
        if result.is_file():
            return pickle.loads(result.read_bytes())
    lines = process.stderr.decode(errors="replace").strip().splitlines()
    reason = f" ({lines[-1]})" if lines else ""
    raise RenderError(
        f"VTK failed{reason}; it needs an OpenGL library (on Debian: libegl1, libgl1)"
    )


def answer() -> None:
    """Render the rows of a request, in a process of its own; see `render`."""
    request, result = map(Path, sys.argv[1:])
    rows, up, views = pickle.loads(request.read_bytes())
    pictures = [_render_row(*row, up, views) for row in rows]
    partial = result.with_suffix(".part")
    partial.write_bytes(pickle.dumps(pictures))
    partial.replace(result)


def upright(vertices: np.ndarray, up: str, view: str = "front") -> np.ndarray:
    """Vertices rotated into a view, with x to the right, y up and z towards the viewer.

    Args:
        vertices: float [V, 3].
        up: The axis that points up, "y" or "z".
        view: "front" or "back".

    Returns:
        float64 [V, 3].
    """
    x, y, z = vertices.astype(np.float64).T
    if up == "z":
        y, z = z, -y
    return np.stack([-x, y, -z] if view == "back" else [x, y, z], axis=1)


def _render_row(meshes, colors, up, views):
    if sys.platform == "linux" and "DISPLAY" not in os.environ:
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    import pyvista  # slow to import

    sizes = [np.ptp(upright(mesh.vertices, up), axis=0) for mesh in meshes]
    # a mesh that is flat in this view has no height
    tall = max(max(size[1], 0.05 * size[0]) for size in sizes)
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
