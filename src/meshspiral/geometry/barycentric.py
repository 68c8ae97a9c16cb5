"""Interpolation of per-vertex values in triangles, by barycentric coordinates."""

from __future__ import annotations

import numpy as np


def interpolate(values: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Interpolate values of vertices linearly inside triangles.

    Args:
        values: float [W, D], one row per vertex, for instance its coordinates.
        corners: int [V, 3], the vertices of the triangle around each point.
        weights: float [V, 3], the barycentric coordinates of each point.

    Returns:
        float [V, D], the value at each point.
    """
    return np.einsum("vk,vkx->vx", weights, values[corners])
