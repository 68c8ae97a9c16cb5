"""How probable it is that a match is right, by the predictions of the network for both meshes.

A network predicts for every vertex a distribution over the template's vertices. A match is right if
source and target vertex belong to the same place of the template. With p the distribution of the
source vertex, q that of the target vertex, and B[i, j] = 1 where the template vertices i and j are
at most RADIUS apart, the probability of that is p^T B q, if the two predictions are independent.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from meshspiral.evaluation.distributions import PAIRS, Distributions

RADIUS = 0.05  # of sqrt(area), the error up to which a match counts as right


def near_confidence(found: Distributions, template: np.ndarray, near: csr_array) -> np.ndarray:
    """The predicted probability that a vertex belongs within RADIUS of its label.

    Args:
        found: Of V vertices.
        template: int [V], their labels; -1 for none.
        near: From `near_vertices`, with RADIUS.

    Returns:
        float32 [V]; 0 without a label.
    """

    def probability(rows: np.ndarray, labels: np.ndarray) -> np.ndarray:
        return near[labels].multiply(found.rows(rows)).sum(axis=1)

    return _of_labels(found, template, probability)


def label_confidence(found: Distributions, template: np.ndarray) -> np.ndarray:
    """The predicted probability of each label.

    Args:
        found: Of V vertices.
        template: int [V], their labels; -1 for none.

    Returns:
        float32 [V]; 0 without a label.
    """

    def probability(rows: np.ndarray, labels: np.ndarray) -> np.ndarray:
        return found.rows(rows)[np.arange(len(rows)), labels]

    return _of_labels(found, template, probability)


def map_confidence(
    source: Distributions, target: Distributions, match: np.ndarray, near: csr_array
) -> np.ndarray:
    """The predicted probability that a source vertex and its match are the same point.

    The same up to RADIUS on the template, as the head of this module says.

    Args:
        source: Of V vertices.
        target: Of the other mesh.
        match: int [V], a target vertex for every source vertex; -1 for none.
        near: From `near_vertices`, with RADIUS.

    Returns:
        float32 [V]; 0 without a match.
    """
    known = match >= 0
    pairs = np.stack([source.row_of[known], target.row_of[match[known]]], axis=1)

    def probability(rows: np.ndarray, others: np.ndarray) -> np.ndarray:
        distinct, of_row = np.unique(rows, return_inverse=True)  # sorted: few in a chunk
        around = source.rows(distinct) @ near
        others, of_other = np.unique(others, return_inverse=True)
        return np.einsum("pk,pk->p", around[of_row], target.rows(others)[of_other])

    return _of_pairs(known, pairs, probability)


def _of_labels(found: Distributions, template: np.ndarray, probability) -> np.ndarray:
    """`_of_pairs` of the rows of `found` and the labels, where a vertex has both."""
    known = (template >= 0) & (found.row_of >= 0)
    pairs = np.stack([found.row_of[known], template[known]], axis=1)
    return _of_pairs(known, pairs, probability)


def _of_pairs(known: np.ndarray, pairs: np.ndarray, probability) -> np.ndarray:
    """Compute each pair once, in chunks: many vertices of a dense mesh share one prediction."""
    values = np.zeros(len(known), dtype=np.float32)
    if known.any():
        distinct, inverse = np.unique(pairs, axis=0, return_inverse=True)
        chunks = [
            probability(*distinct[begin : begin + PAIRS].T)
            for begin in range(0, len(distinct), PAIRS)
        ]
        values[known] = np.clip(np.concatenate(chunks), 0, 1)[inverse.reshape(-1)]
    return values
