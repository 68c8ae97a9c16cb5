"""Rough renders of meshes, for small pictures: quick, and without an OpenGL library."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image, ImageDraw

SHARPER = 2  # drawn so many times as large, then reduced, so that edges are smooth


def sketch(
    points: np.ndarray, faces: np.ndarray, colors: np.ndarray, height: int = 320
) -> np.ndarray:
    """A rough render of a mesh seen from +z with y up, on white.

    Faces are drawn from back to front, before them those that face away, in darker colours: they
    are seen through holes.

    Args:
        points: float [V, 3].
        faces: int [F, 3].
        colors: float [V, 3] in 0..1.
        height: Height of the image in pixels.

    Returns:
        uint8 [height, W, 3]. W fits the mesh, but is at most five times the height.
    """
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = normals[:, 2] / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)
    order = np.lexsort((corners[..., 2].mean(axis=1), facing > 0))
    facing = facing[order, None]
    shade = np.where(facing > 0, 0.35 + 0.65 * facing, 0.35 - 0.15 * facing)
    paint = np.round(255 * shade * colors[faces[order]].mean(axis=1)).astype(int)

    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    tall = max(high[1] - low[1], (high[0] - low[0]) / 5, 1e-300)
    width = max(1, round(height * max(0.2, (high[0] - low[0]) / tall)))
    scale = np.array([1, -1]) * SHARPER * 0.96 * height / tall
    middle = SHARPER * np.array([width, height]) / 2
    place = middle + scale * (corners[order, :, :2] - (low + high) / 2)

    canvas = Image.new("RGB", (SHARPER * width, SHARPER * height), "white")
    draw = ImageDraw.Draw(canvas)
    for triangle, color in zip(place.reshape(-1, 6).tolist(), paint.tolist(), strict=True):
        draw.polygon(triangle, fill=tuple(color))
    return np.asarray(canvas.reduce(SHARPER))


def png(image: np.ndarray) -> bytes:
    """An image, uint8 [H, W, 3], as a PNG file."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "png")
    return buffer.getvalue()
