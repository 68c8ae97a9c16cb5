"""Errors of a correspondence, and the curve of Kim et al. 2011.

Every error here is a geodesic distance on the template between the predicted vertex and the true
one, over the square root of the template's area. Over the geodesic diameter it is the same number
divided by the diameter; the literature has both, so names say which.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torchmetrics import Metric

THRESHOLDS = np.arange(201) / 1000  # of sqrt(area): 0 to 0.2, as in the paper's figures
REPORTED = (0.01, 0.05, 0.10)


def geodesic_errors(
    predicted: np.ndarray,
    labels: np.ndarray,
    distances: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> np.ndarray:
    """float64 [V]: how far from the right vertex of the template the predicted one is.

    predicted, labels: int64 [V], vertices of the template. distances: from sources [K] to targets
    [K], for instance `ReferenceDistances`.
    """
    return distances(labels, predicted)


def point_errors(
    predicted: np.ndarray,
    corners: np.ndarray,
    weights: np.ndarray,
    distances: Callable[[np.ndarray, np.ndarray], np.ndarray],
    place: np.ndarray,
) -> np.ndarray:
    """float64 [V]: how far the predicted vertex is from a point within a face of the template.

    predicted: int64 [V]. corners: int64 [V, 3] and weights: float [V, 3], the point. distances: as
    above. place: float [K, 3], the template's vertices in the unit of the distances. From a corner
    of the face it is a straight line; else the corners' distances, interpolated linearly.
    """
    error = np.zeros(len(predicted))
    for corner, weight in zip(corners.T, weights.T, strict=True):
        error += weight * distances(corner, predicted)
    within = (corners == predicted[:, None]).any(axis=1)
    point = np.einsum("vk,vkx->vx", weights[within], place[corners[within]])
    error[within] = np.linalg.norm(point - place[predicted[within]], axis=1)
    return error


def correspondence_curve(errors: np.ndarray, thresholds: np.ndarray = THRESHOLDS) -> np.ndarray:
    """float64 [T]: the share of errors that are at most each threshold (Kim et al. 2011).

    errors: [V]. thresholds: [T], ascending, inclusive: the value at 0 is the exact-match rate.
    NaN where there are no errors at all.
    """
    if len(errors) == 0:
        return np.full(len(thresholds), np.nan)
    return _counts(errors, thresholds) / len(errors)


def _counts(errors: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """int64 [T]: how many errors are at most each threshold."""
    return np.searchsorted(np.sort(errors), thresholds, side="right")


class CorrespondenceError(Metric):
    """The errors of whole meshes, pooled over all vertices of all of them.

    compute() gives a dictionary of scalars: exact_match, geodesic_error (the mean),
    within_0.01, within_0.05, within_0.10; and `curve`, [T] over THRESHOLDS.
    """

    full_state_update = False

    def __init__(self) -> None:
        super().__init__()
        for name in ("vertices", "exact", "error"):
            self.add_state(name, torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        counts = torch.zeros(len(THRESHOLDS), dtype=torch.float64)
        self.add_state("within", counts, dist_reduce_fx="sum")

    def update(self, errors: np.ndarray, exact: np.ndarray) -> None:
        """errors: float [V], over sqrt(area). exact: bool [V], the right vertex was hit."""
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
