"""Sampled spirals: sequences over the places of a geodesic polar grid."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch
from pydantic import Field, field_validator
from scipy.sparse import csr_array

from meshspiral.geometry import geodesics, patches, sampling
from meshspiral.geometry.mesh import Mesh
from meshspiral.neighbourhoods.base import Arrays, Batch
from meshspiral.neighbourhoods.patch import by_rows_and_columns
from meshspiral.neighbourhoods.starts import (
    StartedSequences,
    StartSettings,
    draw_starts,
    start_title,
)


class Sampled(StartedSequences, name="sampled"):
    """A spiral over the places of a polar grid around each vertex, ring by ring, clockwise.

    Its reach follows the surface, not the edges. Each place gives one vertex, or with `blend` the
    features interpolated from the three vertices of its face.

    Gives `spirals`, int64 [V, L] with L = 1 + rings * rays: vertices; or with `blend` rows of
    `places`, the fields of a `Resampling`. With several starts it is [V, S, L]. With a radius for
    each layer, both are tuples of three.
    """

    gives, noun = "spirals", "sampled spirals"
    density_range = 4.0

    class Settings(StartSettings):
        rings: int = Field(ge=1, description="number of rings of the polar grid")
        rays: int = Field(ge=1, description="number of places of a ring")
        radius: float | list[float] = Field(
            description="radius of the grid, in the unit of `relative_to`; one, or one per layer"
        )
        relative_to: Literal["area", "diameter"] = Field(
            description="unit of the radius: the square root of the surface area, or the geodesic "
            "diameter"
        )
        blend: bool = Field(
            description="interpolate a place's features from three vertices: resampling"
        )

        @field_validator("radius")
        @classmethod
        def _positive(cls, radius: float | list[float]) -> float | list[float]:
            radii = radius if isinstance(radius, list) else [radius]
            if len(radii) not in (1, 3) or not min(radii) > 0:
                raise ValueError("must be a number above 0, or three")
            return radius

    @property
    def title(self) -> str:
        grid = self.settings
        radius = ", ".join(map(str, self._radii))
        kind = "blended" if grid.blend else "sampled"
        unit = "sqrt(area)" if grid.relative_to == "area" else "diameters"
        places = f"1 + {grid.rings} x {grid.rays} places, radius {radius} {unit}"
        return f"{kind} spirals of {places}{start_title(grid)}"

    @property
    def length(self) -> int:
        return 1 + self.settings.rings * self.settings.rays

    @property
    def length_label(self) -> str:
        return f"1 + {self.settings.rings} x {self.settings.rays}"

    @property
    def least_vertices(self) -> int:
        return 1

    @property
    def _radii(self) -> list[float]:
        radius = self.settings.radius
        return radius if isinstance(radius, list) else [radius]

    def compute(self, mesh: Mesh, frames: np.ndarray | None = None) -> Arrays:
        """The places of every radius, first those of the smallest ray number.

        Returns:
            `known` bool [V], whether the first place lies where the frame points. Without `blend`,
            `vertices` int32 [T, V, L] for T radii. With `blend`, for each radius t a sparse matrix
            [V * L, V] in rows, as `Patch.compute` returns it: `indices{t}`, `weights{t}` and
            `first{t}`.
        """
        start, known = patches.first_directions(mesh), np.zeros(len(mesh.vertices), bool)
        if frames is not None:
            directions = sampling.surface_directions(mesh, frames[:, 0])
            known = np.isfinite(directions)
            start = np.where(known, directions, start)
        in_area = self.settings.relative_to == "area"
        unit = mesh.size if in_area else geodesics.diameter(mesh)
        grid = (self.settings.rings, self.settings.rays, start)
        tables = sampling.places_of_radii(mesh, [unit * radius for radius in self._radii], *grid)
        arrays: Arrays = {"known": known}
        if not self.settings.blend:
            arrays["vertices"] = np.stack([sampling.nearest_corners(table) for table in tables])
            return arrays
        for t, table in enumerate(tables):
            indices, weights = (array.reshape(-1, 3) for array in table)
            rows = np.repeat(np.arange(len(indices)), 3)
            shape = (len(indices), len(mesh.vertices))
            matrix = csr_array((weights.ravel(), (rows, indices.ravel())), shape=shape)
            matrix.eliminate_zeros()
            arrays |= {
                f"indices{t}": matrix.indices.astype(np.int32),
                f"weights{t}": matrix.data,
                f"first{t}": matrix.indptr.astype(np.int32),
            }
        return arrays

    def tensors(
        self, arrays: Arrays, mesh: Mesh, frames: np.ndarray | None = None
    ) -> dict[str, Any]:
        # the frame points to place 0 of a ring
        tensors: dict[str, Any] = {"starts": torch.from_numpy(arrays["known"].astype(np.int64) - 1)}
        if not self.settings.blend:
            return tensors | {"sequences": torch.from_numpy(arrays["vertices"])}
        places = []
        for t in range(len(self._radii)):
            matrix = {key: arrays[f"{key}{t}"] for key in ("indices", "weights", "first")}
            fields = by_rows_and_columns(matrix, len(mesh.vertices))
            places.append({name: torch.from_numpy(array) for name, array in fields.items()})
        return tensors | {"places": tuple(places)}

    def draw(self, batch: Batch, generator: torch.Generator, training: bool = False) -> Batch:
        batch = dict(batch)
        starts = batch.pop("starts")
        counts = torch.full_like(starts, self.settings.rays)
        jitter = self.settings.jitter if training else 0
        frames, pooled = None if self.random else starts, self.settings.pooled
        starts = draw_starts(counts, frames, jitter, generator, pooled)
        columns = turned_columns(self.settings.rings, self.settings.rays, starts.device)
        columns = columns.index_select(0, starts.flatten()).view(len(starts), -1)  # [V, S * L]
        if self.settings.blend:
            own = torch.arange(len(starts), device=starts.device) * self.length
            drawn = [own[:, None] + columns] * len(batch["places"])
            if len(drawn) == 1:
                batch["places"] = batch["places"][0]
        else:
            drawn = [table.gather(1, columns).long() for table in batch.pop("sequences")]
        if pooled > 1:
            drawn = [each.unflatten(1, (pooled, self.length)) for each in drawn]
        batch["spirals"] = drawn[0] if len(drawn) == 1 else tuple(drawn)
        return batch


def turned_columns(rings: int, rays: int, device: torch.device | str = "cpu") -> torch.Tensor:
    """The columns of a sampled spiral for every start: each ring is turned by as many places.

    Returns:
        int64 [rays, 1 + rings * rays].
    """
    turned = (torch.arange(rays)[:, None] + torch.arange(rays)) % rays  # [start, position]
    ring = 1 + torch.arange(rings)[:, None] * rays
    columns = (ring + turned[:, None]).flatten(1)
    return torch.cat([torch.zeros(rays, 1, dtype=torch.int64), columns], dim=1).to(device)
