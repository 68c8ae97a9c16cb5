"""Geometry vectors (Litman, Bronstein 2014)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from meshspiral.data.descriptors.base import Descriptor
from meshspiral.data.settings import Strict
from meshspiral.geometry import geovec, laplacian
from meshspiral.geometry.mesh import Mesh

PERCENTILE = 99  # of all training shapes' eigenvalues: where the last band begins


class Geovec(Descriptor, name="geovec"):
    """Energies in overlapping bands of the Laplacian's spectrum, see `geometry_vectors`.

    Eigenvalues are times the surface area, so the descriptor is invariant to scale, and to
    isometries, reflections included. The bands are fitted to the training shapes.
    """

    fitted = "largest"

    class Settings(Strict):
        channels: int = Field(ge=2, description="number of bands, the channels")
        eigenfunctions: int = Field(ge=2, description="number of eigenfunctions of the Laplacian")
        largest: float | None = Field(
            gt=0,
            description="eigenvalue, times the area, where the last band begins; null: fitted to "
            "the training shapes",
        )

    @property
    def channels(self) -> int:
        return self.settings.channels

    def measure(self, mesh: Mesh) -> np.ndarray:
        return laplacian.spectrum(mesh, self.settings.eigenfunctions).values * mesh.size**2

    def fit(self, measured: Sequence[np.ndarray]) -> float:
        return float(np.percentile(np.concatenate(measured), PERCENTILE))

    def compute(self, mesh: Mesh, frames: np.ndarray | None = None) -> np.ndarray:
        values, functions, masses = laplacian.spectrum(mesh, self.settings.eigenfunctions)
        spectrum = laplacian.Spectrum(values * mesh.size**2, functions * mesh.size, masses)
        vectors = geovec.geometry_vectors(spectrum, self.channels, self.settings.largest)
        return (vectors * np.sqrt(self.channels / 544)).astype(np.float32)
