"""Geodesic errors of a correspondence, and their cumulative curve (Kim et al. 2011).

An error is the geodesic distance on the template between the predicted and the true point, divided
by the square root of the template's area. The literature also divides by the geodesic diameter;
metric names say which of the two is meant.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torchmetrics import Metric

from meshspiral.data.shapes import SurfacePoints
from meshspiral.geometry.barycentric import interpolate

THRESHOLDS = np.arange(201) / 1000  # of sqrt(area); 0 to 0.2, the range that Lim et al. 2018 plot
REPORTED = (0.01, 0.05, 0.10)


def geodesic_errors(
    predicted: np.ndarray,
    labels: np.ndarray,
    distances: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> np.ndarray:
    """Geodesic distance of each predicted vertex from the label.

    Args:
        predicted: Template vertices, int64 [V].
        labels: Template vertices, int64 [V].
        distances: Maps sources [K] and targets [K] to their distances [K], e.g.
            `ReferenceDistances`.

    Returns:
        float64 [V], in the unit of `distances`.
    """
    return distances(labels, predicted)


def at_vertices(vertices: np.ndarray) -> SurfacePoints:
    """Vertices of the template, int64 [V], as points on it."""
    return SurfacePoints(vertices[:, None], np.ones((len(vertices), 1)))


def point_errors(
    predicted: SurfacePoints,
    true: SurfacePoints,
    distances: Callable[[np.ndarray, np.ndarray], np.ndarray],
    vertices: np.ndarray,
) -> np.ndarray:
    """Geodesic distances between points of the template: predicted ones, and the true ones.

    If the faces of two points have a vertex in common, this is the straight distance; otherwise it
    is interpolated linearly from the distances between their corners.

    Args:
        predicted: V points within faces, or from `at_vertices`.
        true: V points.
        distances: As for `geodesic_errors`.
        vertices: Positions of the template's vertices in the unit of `distances`, float [K, 3].

    Returns:
        float64 [V], in the unit of `distances`.
    """
    error = np.zeros(len(true.corners))
    for corner, weight in zip(true.corners.T, true.weights.T, strict=True):
        for other, share in zip(predicted.corners.T, predicted.weights.T, strict=True):
            error += weight * share * distances(corner, other)
    near = (predicted.corners[:, :, None] == true.corners[:, None]).any(axis=(1, 2))
    ends = (interpolate(vertices, p.corners[near], p.weights[near]) for p in (predicted, true))
    error[near] = np.linalg.norm(next(ends) - next(ends), axis=1)
    return error


def _counts(errors: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """The number of errors up to each threshold, int64 [T]."""
    return np.searchsorted(np.sort(errors), thresholds, side="right")


class CorrespondenceError(Metric):
    """Mean error, exact-match rate and curve, pooled over all vertices of all meshes.

    `compute` returns the scalars `exact_match`, `geodesic_error` (the mean), `within_0.01`,
    `within_0.05` and `within_0.10` (shares of vertices), and `curve`, float64 [T] over THRESHOLDS.
    """

    full_state_update = False

    def __init__(self) -> None:
        super().__init__()
        for name in ("vertices", "exact", "error"):
            self.add_state(name, torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        counts = torch.zeros(len(THRESHOLDS), dtype=torch.float64)
        self.add_state("within", counts, dist_reduce_fx="sum")

    def update(self, errors: np.ndarray, exact: np.ndarray) -> None:
        """Add the vertices of a mesh.

        Args:
            errors: Errors over sqrt(area), float [V].
            exact: Whether the predicted vertex is the label, bool [V].
        """
        self.vertices += len(errors)
        self.exact += int(exact.sum())
        self.error += float(errors.sum())
        self.within += torch.from_numpy(_counts(errors, THRESHOLDS)).to(self.within.device)

    def compute(self) -> dict[str, torch.Tensor]:
        curve = self.within / self.vertices
        return {
            "exact_match": self.exact / self.vertices,
            "geodesic_error": self.error / self.vertices,
            **{
                f"within_{radius:.2f}": curve[int(np.searchsorted(THRESHOLDS, radius))]
                for radius in REPORTED
            },
            "curve": curve,
        }
