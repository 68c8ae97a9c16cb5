"""Anisotropic heat kernels, the patches of ACNN (Boscaini, Masci, Rodola, Bronstein 2016)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from pydantic import Field, field_validator

from meshspiral.geometry import anisotropic, curvature, geodesics
from meshspiral.geometry.mesh import Mesh
from meshspiral.neighbourhoods.base import Arrays, Neighbourhood
from meshspiral.neighbourhoods.patch import by_rows_and_columns

DIAMETER = 200.0  # of a shape in the unit of the times
ALL, SOME = 2000, 300  # vertices up to which all eigenfunctions are taken, and how many else


class Anisotropic(Neighbourhood, name="anisotropic"):
    """Heat kernels around each vertex, each fast in one direction, for several times and angles.

    Directions relate to those of principal curvature. Gives `patches`, the fields of
    `meshspiral.nn.geodesic.Resampling`, with times as rings and angles as rays.
    """

    gives, noun = "patches", "anisotropic heat kernels"
    density_range = 2.0

    class Settings(Neighbourhood.Settings):
        times: list[float] = Field(
            min_length=1,
            description="diffusion times; the geodesic diameter of a shape is 200",
        )
        angles: int = Field(ge=2, description="number of directions in half a turn, even")
        anisotropy: float = Field(
            ge=0, description="heat is 1 + anisotropy times as fast in one direction"
        )
        entries: int = Field(ge=1, description="vertices that a kernel keeps")
        smoothing: int = Field(ge=0, description="averagings of the curvature over one-rings")
        eigenfunctions: int | None = Field(
            ge=2,
            description="eigenfunctions of each kernel; null: all of a mesh of up to 2,000 "
            "vertices, which is exact, and 300 of a larger one",
        )

        @field_validator("times")
        @classmethod
        def _positive(cls, times: list[float]) -> list[float]:
            if min(times) <= 0:
                raise ValueError("must be above 0")
            return times

        @field_validator("angles")
        @classmethod
        def _even(cls, angles: int) -> int:
            if angles % 2:
                raise ValueError("must be even")
            return angles

    @property
    def title(self) -> str:
        own = self.settings
        return f"anisotropic heat kernels of {len(own.times)} times and {own.angles} angles"

    @property
    def grid(self) -> tuple[int, int]:
        """Numbers of rings and rays, for networks that read patches."""
        return len(self.settings.times), self.settings.angles

    def compute(self, mesh: Mesh) -> Arrays:
        """The kernels, `indices` int32 and `weights` float32 [V, A, T, K], see `KernelTable`."""
        own = self.settings
        unit = geodesics.diameter(mesh) / DIAMETER
        count = own.eigenfunctions or (None if len(mesh.vertices) <= ALL else SOME)
        scaled = Mesh(mesh.vertices / unit, mesh.faces, mesh.name)
        tensors = curvature.curvature_tensors(scaled, own.smoothing)
        directions = curvature.principal_directions(scaled, tensors)
        table = anisotropic.anisotropic_kernels(
            scaled,
            directions,
            own.times,
            own.angles,
            own.anisotropy,
            own.entries,
            count,
        )
        return {
            name: np.ascontiguousarray(array.transpose(0, 2, 1, 3))
            for name, array in table._asdict().items()
        }

    def tensors(self, arrays: Arrays, mesh: Mesh) -> dict[str, Any]:
        samples, entries = arrays["indices"].size, arrays["indices"].shape[-1]
        rows = {
            "indices": arrays["indices"].ravel(),
            "weights": arrays["weights"].ravel(),
            "first": np.arange(0, samples + 1, entries, dtype=np.int32),
        }
        both = by_rows_and_columns(rows, len(mesh.vertices))
        return {"patches": {name: torch.from_numpy(array) for name, array in both.items()}}
