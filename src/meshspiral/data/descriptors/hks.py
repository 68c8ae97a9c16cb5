"""Heat kernel signatures (Sun, Ovsjanikov, Guibas 2009)."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from meshspiral.data.descriptors.base import Descriptor
from meshspiral.data.settings import Strict
from meshspiral.geometry import laplacian
from meshspiral.geometry.mesh import Mesh

TIMES = (0.01, 1.0)  # over the surface area


class Hks(Descriptor, name="hks"):
    """How much heat is left at a vertex some time after it was put there, for several times.

    At vertex x and time t that is the sum over eigenfunctions f of the Laplacian, with eigenvalues
    v, of exp(-v t) f(x)^2. It is invariant to isometries, reflections included, so it cannot tell
    left from right. Each channel is divided by its mean over the surface, and 1 is subtracted.
    Times are logarithmically spaced in `TIMES`, over the surface area.
    """

    class Settings(Strict):
        times: int = Field(ge=1, description="number of times, the channels")
        eigenfunctions: int = Field(ge=2, description="number of eigenfunctions of the Laplacian")

    @property
    def channels(self) -> int:
        return self.settings.times

    def compute(self, mesh: Mesh, frames: np.ndarray | None = None) -> np.ndarray:
        values, functions, masses = laplacian.spectrum(mesh, self.settings.eigenfunctions)
        times = np.geomspace(*TIMES, self.settings.times) * mesh.size**2
        kernel = functions**2 @ np.exp(-values[:, None] * times)
        mean = masses @ kernel / masses.sum()
        return ((kernel / mean - 1) / np.sqrt(544)).astype(np.float32)
