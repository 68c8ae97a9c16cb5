"""The operators of DiffusionNet (Sharp, Attaiki, Crane, Ovsjanikov 2022)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from pydantic import Field

from meshspiral.geometry import gradients, laplacian
from meshspiral.geometry.mesh import Mesh
from meshspiral.neighbourhoods.base import Arrays, Neighbourhood
from meshspiral.neighbourhoods.patch import by_rows_and_columns


class Operators(Neighbourhood, name="operators"):
    """The smallest eigenfunctions of the Laplacian, and gradients at the vertices.

    Gives `operators`, the fields of `meshspiral.nn.diffusion.SurfaceOperators`. Lengths are over
    the square root of the surface area.
    """

    gives, noun = "operators", "operators"
    density_range = 4.0  # of a surface, not of its edges

    class Settings(Neighbourhood.Settings):
        eigenfunctions: int = Field(ge=1, description="number of eigenfunctions of the Laplacian")

    @property
    def title(self) -> str:
        return f"{self.settings.eigenfunctions} eigenfunctions"

    def compute(self, mesh: Mesh) -> Arrays:
        """The operators.

        Returns:
            `values` float32 [K], `functions` float32 [V, K], `masses` float32 [V], and of the
            gradients `indices` int32 [E], `weights` float32 [E, 2] and `first` int32 [V + 1], see
            `Spectrum` and `Gradients`. A mesh of fewer vertices than eigenfunctions has
            K = V.
        """
        found = laplacian.spectrum(mesh, self.settings.eigenfunctions)
        slopes = gradients.vertex_gradients(mesh)
        size = mesh.size
        return {
            "values": (found.values * size**2).astype(np.float32),
            "functions": (found.functions * size).astype(np.float32),
            "masses": (found.masses / size**2).astype(np.float32),
            "indices": slopes.indices,
            "weights": (slopes.weights * size).astype(np.float32),
            "first": slopes.first,
        }

    def tensors(self, arrays: Arrays, mesh: Mesh) -> dict[str, Any]:
        spectral = {
            name: torch.from_numpy(arrays[name]) for name in ("values", "functions", "masses")
        }
        slopes = by_rows_and_columns(both_axes(arrays), len(mesh.vertices))
        slopes = {name: torch.from_numpy(array) for name, array in slopes.items()}
        return {"operators": {**spectral, "gradients": slopes}}


def both_axes(arrays: Arrays) -> Arrays:
    """The gradients as rows of one sparse matrix [2 V, V]: 2 v and 2 v + 1 for the axes of v.

    Args:
        arrays: `indices` [E], `weights` [E, 2] and `first` [V + 1], as of `Gradients`.
    """
    first = arrays["first"].astype(np.int64)
    counts = np.repeat(np.diff(first), 2)
    rows = np.concatenate([[0], np.cumsum(counts)])
    entries = np.repeat(np.repeat(first[:-1], 2) - rows[:-1], counts) + np.arange(rows[-1])
    axis = np.repeat(np.arange(len(counts)) % 2, counts)
    return {
        "indices": arrays["indices"][entries],
        "weights": arrays["weights"][entries, axis],
        "first": rows.astype(np.int32),
    }
