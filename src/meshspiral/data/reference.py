"""Geodesic distances on the template, with which errors are measured."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import partial
from importlib.metadata import version

import numpy as np

from meshspiral.data.cache import Cache, code_version
from meshspiral.data.progress import Progress
from meshspiral.geometry import geodesics, mesh
from meshspiral.geometry.digest import digest
from meshspiral.geometry.mesh import Mesh

BLOCK = 256  # rows per cached file


class ReferenceDistances:
    """Geodesic distances between template vertices over sqrt(template area), computed on demand.

    Rows are computed in blocks of consecutive vertices and cached on disk and in memory. There is
    no path between two components of the template; such a distance counts as the diameter.

    Args:
        template: The template.
        cache: Cache of the rows and the diameter.

    Attributes:
        diameter: Geodesic diameter of the template over sqrt(area). An error over sqrt(area),
            divided by it, is the error over the diameter.
        place: Template vertices over sqrt(area), float64 [K, 3].
    """

    def __init__(self, template: Mesh, cache: Cache):
        self.template, self._cache = template, cache
        self._blocks: dict[int, np.ndarray] = {}
        self._solver: geodesics.GeodesicSolver | None = None
        versions = code_version(geodesics, mesh, sys.modules[__name__]), version("potpourri3d")
        self._key = digest(template.vertices, template.faces, *versions)
        self._unit = np.sqrt(template.area)
        self.place = template.vertices / self._unit
        cached = cache.get("diameter", self._key, self._compute_diameter)
        self.diameter = float(cached["diameter"])

    def prepare(self) -> None:
        """Compute and cache all distances."""
        for _ in self._all_blocks("Geodesic distances"):
            pass

    def __call__(self, sources: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Distances between pairs of vertices.

        Args:
            sources: Template vertices, int64 [K].
            targets: Template vertices, int64 [K].

        Returns:
            Distance from sources[k] to targets[k] over sqrt(area), float64 [K].
        """
        distances = np.zeros(len(sources))
        apart = np.flatnonzero(sources != targets)
        blocks = sources[apart] // BLOCK
        progress = Progress(
            np.unique(blocks), desc="Geodesic distances", unit="block", leave=False, delay=1.0
        )
        for block in progress:
            pairs = apart[blocks == block]
            distances[pairs] = self._block(int(block))[sources[pairs] % BLOCK, targets[pairs]]
        return distances

    def heat_kernel(self, width: float) -> tuple[np.ndarray, np.ndarray]:
        """The heat kernel around every vertex, as a probability distribution over the vertices.

        For short times t the kernel is exp(-d^2 / 4t) of the geodesic distance d (Varadhan 1967);
        width = sqrt(2t) is its standard deviation. A vertex's probability is the kernel times its
        share of the area. Vertices beyond three widths are left out.

        Args:
            width: Over sqrt(template area). With 0 each vertex keeps all of its probability.

        Returns:
            Vertices, int64 [K, M], and their probabilities, float32 [K, M]. M is the largest number
            of vertices within three widths; a row with fewer ends with probabilities of 0.
        """
        count, areas = len(self.template.vertices), self.template.vertex_areas
        if width == 0:
            return np.arange(count)[:, None], np.ones((count, 1), np.float32)
        rows = []
        for block, found in self._all_blocks("Soft labels"):
            for v, distances in enumerate(found, start=block * BLOCK):
                near = np.flatnonzero(distances < 3 * width)
                near = np.union1d(near, [v])
                weights = np.exp(-0.5 * (distances[near] / width) ** 2) * areas[near]
                total = weights.sum()
                rows.append((near, weights / total if total > 0 else 1.0 * (near == v)))
        longest = max(len(near) for near, _ in rows)
        vertices = np.zeros((count, longest), np.int64)
        weights = np.zeros((count, longest), np.float32)
        for v, (near, probabilities) in enumerate(rows):
            vertices[v, : len(near)], weights[v, : len(near)] = near, probabilities
        return vertices, weights

    def _all_blocks(self, title: str) -> Iterator[tuple[int, np.ndarray]]:
        """All blocks with their numbers, with a progress bar."""
        numbers = range(-(-len(self.template.vertices) // BLOCK))
        for block in Progress(numbers, desc=title, unit="block", leave=False, delay=1.0):
            yield block, self._block(block)

    def _block(self, block: int) -> np.ndarray:
        if block not in self._blocks:
            key, compute = f"{self._key}-{block}", partial(self._compute, block)
            rows = self._cache.get("distances", key, compute)
            # as a mapped file, so that the system may drop its pages
            rows = self._cache.load("distances", key, check=False) or rows
            self._blocks[block] = rows["distances"]
        return self._blocks[block]

    def _compute(self, block: int) -> dict[str, np.ndarray]:
        self._solver = self._solver or geodesics.GeodesicSolver(self.template)
        last = min((block + 1) * BLOCK, len(self.template.vertices))
        rows = np.stack([self._solver.row(v) for v in range(block * BLOCK, last)]) / self._unit
        rows[~np.isfinite(rows)] = self.diameter
        return {"distances": rows.astype(np.float32)}

    def _compute_diameter(self) -> dict[str, np.ndarray]:
        return {"diameter": np.array(geodesics.diameter(self.template) / self._unit)}
