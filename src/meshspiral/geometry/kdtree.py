"""Nearest points in space."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree


def kd_tree(points: np.ndarray) -> cKDTree:
    """A k-d tree of points, float [P, D], whose nodes are split in the middle, not at the median.

    SciPy splits off points at a median of 0 by the smallest denormal number above it. Where
    denormal numbers count as 0, as in our training and matching, it would recurse without end.
    """
    return cKDTree(points, balanced_tree=False)
