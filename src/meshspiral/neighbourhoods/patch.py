"""Geodesic polar patches, the neighbourhoods of GCNN3 (Masci et al. 2015)."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch
from pydantic import Field, field_validator
from scipy.sparse import csr_array

from meshspiral.geometry import geodesics, patches, windows
from meshspiral.geometry.mesh import Mesh
from meshspiral.neighbourhoods.base import Arrays, Neighbourhood


class Patch(Neighbourhood, name="patch"):
    """A polar grid around each vertex, resampled from the vertices near it.

    Gives `patches`, the fields of `meshspiral.nn.geodesic.Resampling`.
    """

    gives, noun = "patches", "patches"
    density_range = 4.0  # the radius follows the surface, not the edges

    class Settings(Neighbourhood.Settings):
        radius: float = Field(
            gt=0, description="radius of a patch over the geodesic diameter (original: 0.01)"
        )
        rings: int = Field(ge=1, description="number of rings of the polar grid")
        rays: int = Field(ge=2, description="number of rays of the polar grid, even")
        weights: Literal["interpolation", "gaussian"] = Field(
            description="how a sample is blended: interpolation within its triangle, or gaussian "
            "windows as in the original"
        )

        ring_width: float = Field(
            gt=0,
            description="width of a gaussian window over the spacing of the rings; the authors' "
            "published code has 2 in one copy, 0.2 in another",
        )

        @field_validator("rays")
        @classmethod
        def _even(cls, rays: int) -> int:
            if rays % 2:
                raise ValueError("must be even")
            return rays

    @property
    def title(self) -> str:
        grid = self.settings
        return f"patches of {grid.rings} x {grid.rays} samples, radius {grid.radius} diameters"

    @property
    def grid(self) -> tuple[int, int]:
        """Numbers of rings and rays, for networks that read patches."""
        return self.settings.rings, self.settings.rays

    def compute(self, mesh: Mesh) -> Arrays:
        """The samples as a sparse matrix [V * rays * rings, V] in rows.

        Returns:
            `indices` int32 [E], `weights` float32 [E] and `first` int32 [V * rays * rings + 1]:
            sample s is the sum of weights[k] f[indices[k]] over k in first[s]:first[s+1]. Samples
            are ordered by vertex, then ray, then ring.
        """
        settings = self.settings
        radius = settings.radius * geodesics.diameter(mesh)
        grid = (radius, settings.rings, settings.rays, patches.first_directions(mesh))
        if settings.weights == "gaussian":
            indices, weights, first = windows.gaussian_windows(mesh, *grid, settings.ring_width)
        else:
            table = patches.geodesic_patches(mesh, *grid)
            exists = table.exists.ravel()
            indices, weights = (array.reshape(-1, 3)[exists].ravel() for array in table)
            first = 3 * np.concatenate([[0], np.cumsum(exists)])
        samples = csr_array((weights, indices, first), shape=(len(first) - 1, len(mesh.vertices)))
        rows = np.arange(len(first) - 1).reshape(-1, settings.rings, settings.rays)
        by_ray = samples[rows.transpose(0, 2, 1).ravel()]
        return {
            "indices": by_ray.indices.astype(np.int32),
            "weights": by_ray.data,
            "first": by_ray.indptr.astype(np.int32),
        }

    def tensors(self, arrays: Arrays, mesh: Mesh) -> dict[str, Any]:
        both = by_rows_and_columns(arrays, len(mesh.vertices))
        return {"patches": {name: torch.from_numpy(array) for name, array in both.items()}}


def by_rows_and_columns(arrays: Arrays, vertices: int) -> Arrays:
    """The fields of `meshspiral.nn.geodesic.Resampling` from the arrays of `Patch.compute`.

    Args:
        arrays: `indices`, `weights` and `first`.
        vertices: Number of vertices of the mesh.
    """
    shape = (len(arrays["first"]) - 1, vertices)
    rows = csr_array((arrays["weights"], arrays["indices"], arrays["first"]), shape=shape)
    columns = rows.tocsc()
    return {
        "vertices": rows.indices,
        "weights": rows.data,
        "first": rows.indptr,
        "samples": columns.indices,
        "sample_weights": columns.data,
        "sample_first": columns.indptr,
    }
