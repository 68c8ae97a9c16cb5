"""What a network predicts for a mesh, as distributions over the vertices of the template."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from meshspiral.geometry.faces import directed_edges
from meshspiral.geometry.mesh import Mesh

SPREAD = 0.07  # over sqrt(area): how far around a label its point is averaged
DETOUR = 1.5  # longest way along edges, in units of the radius: leaves out a neighbouring finger
PAIRS = 512  # pairs of vertices per chunk
TINY = 1e-20  # probability below which a neighbourhood says nothing
ROWS = 256  # rows of distances per chunk


class Distributions(NamedTuple):
    """The predicted distributions of a mesh, in the form in which the network has them.

    Attributes:
        embedding: float [W, C], the input of the last layer, for each vertex that was predicted.
        weight: float [K, C], of the last layer.
        bias: float [K].
        row_of: int64 [V], the row of `embedding` of every given vertex; -1 for none.
        side: int8 [W], the side of the template where a vertex is known to belong: 1, -1, or 0 for
            not known. The probabilities are those under that condition.
        sides: int8 [K], the side of each template vertex, 0 on the mirror; required with `side`.
        temperature: By which the scores of the last layer are divided in `weight` and `bias`.
    """

    embedding: Tensor
    weight: Tensor
    bias: Tensor
    row_of: np.ndarray
    side: np.ndarray | None = None
    sides: np.ndarray | None = None
    temperature: float = 1.0

    def rows(self, rows: np.ndarray, sharpened: bool = True) -> np.ndarray:
        """Probabilities of the template's vertices, float [R, K], for some rows [R].

        Args:
            rows: int [R].
            sharpened: Whether a temperature below 1 counts, which makes them sharper than trained.
        """
        return np.exp(self.log_rows(rows, sharpened))

    @torch.inference_mode()
    def log_rows(self, rows: np.ndarray, sharpened: bool = True) -> np.ndarray:
        """Their logarithms, float [R, K]; -inf on the other side of the template."""
        x = self.embedding[torch.from_numpy(rows).to(self.embedding.device)]
        scores = torch.addmm(self.bias, x.to(self.weight.dtype), self.weight.T)
        if not sharpened and self.temperature < 1:
            scores *= self.temperature
        if self.side is not None:
            other = torch.from_numpy(self.side[rows, None] * self.sides < 0)
            scores = scores.masked_fill(other.to(scores.device), -torch.inf)
        return torch.log_softmax(scores, dim=1).cpu().numpy()


def near_vertices(template: Mesh, radius: float) -> csr_array:
    """Pairs of template vertices at most a radius apart, which is given over sqrt(area).

    The distance is the straight one, which on a surface differs little at this length. Vertices
    that are further apart along edges than DETOUR are left out.

    Returns:
        float32 [K, K], 1 for each pair, also for a vertex and itself.
    """
    size, radius = len(template.vertices), radius * np.sqrt(template.area)
    start, tip = directed_edges(template.faces).T  # each once
    lengths = np.linalg.norm(template.vertices[start] - template.vertices[tip], axis=1)
    graph = csr_array((lengths, (start, tip)), shape=(size, size))
    found = []
    for begin in range(0, size, ROWS):
        block = np.arange(begin, min(begin + ROWS, size))
        along = dijkstra(graph, directed=False, indices=block, limit=DETOUR * radius)
        row, column = np.nonzero(np.isfinite(along))
        offsets = template.vertices[block[row]] - template.vertices[column]
        close = np.linalg.norm(offsets, axis=1) <= radius
        found.append(np.stack([block[row[close]], column[close]]))
    i, j = np.concatenate(found, axis=1)
    return csr_array((np.ones(len(i), dtype=np.float32), (i, j)), shape=(size, size))


def soft_points(
    found: Distributions, template: np.ndarray, near: csr_array, vertices: np.ndarray
) -> np.ndarray:
    """The mean of the template's vertices near each label, by their predicted probabilities.

    A mesh that is denser than the template thus gets points between the template's vertices. A
    network that learnt barycentric coordinates as labels predicts these, and a temperature that
    calibrates single vertices would sharpen them; it is left out.

    Args:
        found: Of V vertices.
        template: int [V], their labels; -1 for none.
        near: From `near_vertices`.
        vertices: float64 [K, 3], of the template.

    Returns:
        float64 [V, 3], each as near to its label as those vertices; NaN without a label.
    """
    points = np.full((len(template), 3), np.nan)
    known = np.flatnonzero((template >= 0) & (found.row_of >= 0))
    for begin in range(0, len(known), PAIRS):
        chunk = known[begin : begin + PAIRS]
        weights = (
            near[template[chunk]].multiply(found.rows(found.row_of[chunk], sharpened=False)).tocsr()
        )
        total = weights.sum(axis=1)[:, None]
        mean = (weights @ vertices) / np.maximum(total, TINY)
        points[chunk] = np.where(total > TINY, mean, vertices[template[chunk]])
    return points
