"""Geodesic distances on the template: what an error is measured with."""

from __future__ import annotations

from functools import partial

import numpy as np
from tqdm import tqdm

from src.data.store import Store, code_version, digest
from src.geometry import geodesics
from src.geometry.mesh import Mesh

BLOCK = 256  # rows kept in one file


class ReferenceDistances:
    """Distances between template vertices over sqrt(template area), computed as they are needed.

    Rows are computed in blocks of neighbouring vertex numbers and kept on disk and in memory.
    diameter: the template's geodesic diameter, over sqrt(area) too, so that an error over the
    diameter is an error over sqrt(area) divided by it. Between two components of the template
    there is no path; such a distance counts as the diameter.
    """

    def __init__(self, template: Mesh, store: Store):
        self.template, self._store = template, store
        self._blocks: dict[int, np.ndarray] = {}
        self._solver: geodesics.GeodesicSolver | None = None
        self._key = digest(template.vertices, template.faces, BLOCK, code_version(geodesics))
        self._unit = np.sqrt(template.area)
        kept = store.get("diameter", self._key, self._compute_diameter)
        self.diameter = float(kept["diameter"])

    def __call__(self, sources: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """float64 [K]: the distance from sources[k] to targets[k], both int64 [K]."""
        distances = np.zeros(len(sources))
        apart = np.flatnonzero(sources != targets)
        blocks = sources[apart] // BLOCK
        self._ensure(np.unique(blocks))
        for block in np.unique(blocks):
            pairs = apart[blocks == block]
            distances[pairs] = self._blocks[block][sources[pairs] % BLOCK, targets[pairs]]
        return distances

    def _ensure(self, blocks: np.ndarray) -> None:
        missing = [int(block) for block in blocks if block not in self._blocks]
        progress = tqdm(missing, desc="Geodesic distances", unit="block", leave=False, delay=1.0)
        for block in progress:
            key, compute = f"{self._key}-{block}", partial(self._compute, block)
            self._blocks[block] = self._store.get("distances", key, compute)["distances"]

    def _compute(self, block: int) -> dict[str, np.ndarray]:
        self._solver = self._solver or geodesics.GeodesicSolver(self.template)
        last = min((block + 1) * BLOCK, len(self.template.vertices))
        rows = np.stack([self._solver.row(v) for v in range(block * BLOCK, last)]) / self._unit
        rows[~np.isfinite(rows)] = self.diameter
        return {"distances": rows.astype(np.float32)}

    def _compute_diameter(self) -> dict[str, np.ndarray]:
        return {"diameter": np.array(geodesics.diameter(self.template) / self._unit)}
