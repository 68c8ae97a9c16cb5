"""Interpolation of per-vertex values in triangles, by barycentric coordinates."""

from __future__ import annotations

import numpy as np


def interpolate(values: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Interpolate values of vertices linearly inside triangles.

    Args:
        values: float [W, D], one row per vertex, for instance its coordinates.
        corners: int [..., 3], the vertices of the triangle around each point.
        weights: float [..., 3], the barycentric coordinates of each point.

    Returns:
        float [..., D], the value at each point.
    """
    return np.einsum("...k,...kx->...x", weights, values[corners])
