"""Spirals of vertices (Lim et al. 2018, section 3.1), with a start drawn at random."""

from __future__ import annotations

from typing import Any

import torch
from pydantic import Field

from meshspiral.geometry import connectivity, spirals
from meshspiral.geometry.mesh import Mesh
from meshspiral.neighbourhoods.base import Arrays, Batch, Neighbourhood


class Spiral(Neighbourhood, name="spiral"):
    """The spiral around each vertex: N vertices, or all vertices of k rings.

    Gives `spirals`, int64 [V, N]: one spiral of every vertex, each start equally likely; -1 where a
    spiral has ended.
    """

    gives, noun = "spirals", "spirals"
    modules = (connectivity, spirals)
    random = True

    class Settings(Neighbourhood.Settings):
        seq_len: int = Field(ge=1, description="number of vertices N of a spiral")
        rings: int | None = Field(
            ge=1, description="number of whole rings of a spiral, instead of seq_len vertices"
        )

    @property
    def title(self) -> str:
        rings = self.settings.rings
        return f"spirals of {f'{rings} rings' if rings else f'{self.length} vertices'}"

    @property
    def length(self) -> int | None:
        return None if self.settings.rings else self.settings.seq_len

    @property
    def length_label(self) -> str:
        return f"{self.settings.rings} rings" if self.settings.rings else f"N = {self.length}"

    def mesh_key(self, mesh: Mesh) -> tuple:
        """The one-rings: meshes with equal connectivity share one table."""
        return connectivity.one_rings(mesh)

    def compute(self, mesh: Mesh) -> Arrays:
        """`sequences` and `first` of a `SpiralTable`."""
        table = spirals.spiral_table(mesh, self.length, rings=self.settings.rings)
        return {"sequences": table.sequences, "first": table.first}

    def tensors(self, arrays: Arrays, mesh: Mesh) -> dict[str, Any]:
        return {name: torch.from_numpy(array) for name, array in arrays.items()}

    def draw(self, batch: Batch, generator: torch.Generator) -> Batch:
        batch = dict(batch)
        sequences, first = batch.pop("sequences"), batch.pop("first")
        batch["spirals"] = draw_spirals(sequences, first, generator)
        return batch


def draw_spirals(
    sequences: torch.Tensor, first: torch.Tensor, generator: torch.Generator | None = None
) -> torch.Tensor:
    """Draw one spiral of every vertex, each start equally likely.

    Args:
        sequences: int [R, N], see `SpiralTable`, on any device.
        first: int64 [V+1], see `SpiralTable`.
        generator: On the same device; None for torch's default.

    Returns:
        int64 [V, N].
    """
    starts = first.diff()
    draw = torch.rand(len(starts), device=first.device, generator=generator)
    # draw < 1, but a float32 just below 1 times the count may round up to the count
    step = (draw * starts).long().clamp(max=starts - 1)
    return sequences.index_select(0, first[:-1] + step).long()
