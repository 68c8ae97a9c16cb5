"""Interpolation by barycentric coordinates."""

from __future__ import annotations

import numpy as np

from meshspiral.geometry.barycentric import interpolate


def test_interpolation_gives_values_at_corners_and_means_at_centroids():
    values = np.array([[0.0, 0.0], [6.0, 0.0], [0.0, 3.0], [9.0, 9.0]])
    corners = np.array([[0, 1, 2], [3, 2, 1]])
    weights = np.array([[1 / 3, 1 / 3, 1 / 3], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(interpolate(values, corners, weights), [[2, 1], [9, 9]])


def test_interpolation_is_exact_for_linear_functions():
    rng = np.random.default_rng(0)
    points, corners = rng.normal(size=(20, 3)), rng.integers(20, size=(50, 3))
    weights = rng.dirichlet(np.ones(3), size=50)
    matrix, offset = rng.normal(size=(3, 2)), rng.normal(size=2)
    expected = interpolate(points, corners, weights) @ matrix + offset
    np.testing.assert_allclose(interpolate(points @ matrix + offset, corners, weights), expected)
