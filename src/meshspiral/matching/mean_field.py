"""Refinement of labels by the labels of neighbours: mean-field inference in a random field.

The labels of a mesh are a conditional random field. Its unary potentials are the log-probabilities
of the network. Its pairwise potentials favour neighbours whose labels are near on the template:
exp(-d^2 / 2 WIDTH^2) at a distance d over sqrt(area). The mean field is found by the parallel
updates of Krähenbühl and Koltun, "Efficient inference in fully connected CRFs with Gaussian edge
potentials" (2011); here the graph is that of the mesh's edges. Unlike ZoomOut it needs neither a
complete surface nor equal areas.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.special import softmax

from meshspiral.evaluation.distributions import near_vertices
from meshspiral.geometry.faces import directed_edges
from meshspiral.geometry.mesh import Mesh

WIDTH = 0.04  # over sqrt(area) of the template
REACH = 2.5  # widths, beyond which the potential is 0
STRENGTH = 8.0  # weight of the neighbours
STEPS = 5
MOST_HOPS = 8
NEAR = 0.05  # over sqrt(area), see `likeliest_near`
ROWS = 256  # vertices at a time


class MeanField:
    """The pairwise potentials of a template, to refine labels of many meshes.

    Args:
        template: The mesh with K vertices.
    """

    def __init__(self, template: Mesh):
        pairs = near_vertices(template, REACH * WIDTH).tocoo()
        i, j = pairs.coords
        apart = np.linalg.norm(template.vertices[i] - template.vertices[j], axis=1) / template.size
        weights = np.exp(-((apart / WIDTH) ** 2) / 2).astype(np.float32)
        self._kernel = csr_array((weights, (i, j)), shape=pairs.shape)

    def __call__(self, log_probability: np.ndarray, mesh: Mesh) -> np.ndarray:
        """Refine the labels of a mesh.

        Args:
            log_probability: float32 [W, K], of the network, for every vertex of the mesh.
            mesh: W vertices.

        Returns:
            int64 [W], the likeliest template vertex under the mean field.
        """
        mean = neighbour_mean(mesh)
        hops = int(np.clip(round(len(mesh.vertices) / self._kernel.shape[0]), 1, MOST_HOPS))
        field = np.exp(log_probability)
        for _ in range(STEPS):
            for _ in range(hops):  # about as far on a dense mesh as on the template
                field = mean @ field
            message = (self._kernel @ np.ascontiguousarray(field.T)).T
            field = softmax(log_probability + STRENGTH * message, axis=1)
        return field.argmax(axis=1)


def likeliest_near(log_probability: np.ndarray, labels: np.ndarray, template: Mesh) -> np.ndarray:
    """The likeliest label of each vertex if its place is known up to a normal distribution.

    Args:
        log_probability: float32 [W, K], of the network.
        labels: int64 [W], the template vertices at the means of the distributions, whose standard
            deviation is NEAR sqrt(area).
        template: The mesh with K vertices.

    Returns:
        int64 [W].
    """
    found = np.empty_like(labels)
    places = template.vertices / template.size
    for begin in range(0, len(labels), ROWS):
        rows = slice(begin, begin + ROWS)
        squares = ((places[labels[rows], None] - places) ** 2).sum(axis=2)
        found[rows] = (log_probability[rows] - squares / (2 * NEAR**2)).argmax(axis=1)
    return found


def neighbour_mean(mesh: Mesh) -> csr_array:
    """The matrix that takes values at vertices to the mean over each vertex's one-ring, [W, W]."""
    count = len(mesh.vertices)
    start, tip = directed_edges(mesh.faces).T
    ones = np.ones(len(start), dtype=np.float32)
    graph = csr_array((ones, (start, tip)), shape=(count, count))
    graph = ((graph + graph.T) > 0).astype(np.float32)
    degree = np.maximum(np.asarray(graph.sum(axis=1)).ravel(), 1)
    return csr_array(diags_array((1 / degree).astype(np.float32)) @ graph)
