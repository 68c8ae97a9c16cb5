"""Spirals of vertices (Lim et al. 2018, section 3.1)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from pydantic import Field, field_validator

from meshspiral.geometry import connectivity, spirals
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.sampling import nearest_neighbours
from meshspiral.neighbourhoods.base import Arrays, Batch
from meshspiral.neighbourhoods.starts import (
    StartedSequences,
    StartSettings,
    draw_starts,
    start_title,
)


class Spiral(StartedSequences, name="spiral"):
    """The spiral around each vertex: N vertices, or all vertices of k rings.

    Gives `spirals`, int64 [V, N]: one spiral of every vertex; -1 where it has ended. With several
    starts it is [V, S, N]. With a dilation for each layer it is a tuple of three.
    """

    gives, noun = "spirals", "spirals"

    class Settings(StartSettings):
        seq_len: int = Field(ge=1, description="number of vertices N of a spiral")
        rings: int | None = Field(
            ge=1, description="number of whole rings of a spiral, instead of seq_len vertices"
        )
        dilation: int | list[int] = Field(
            description="take every d-th vertex of a longer spiral; one number, or one per layer"
        )

        @field_validator("dilation")
        @classmethod
        def _steps(cls, dilation: int | list[int]) -> int | list[int]:
            steps = dilation if isinstance(dilation, list) else [dilation]
            if len(steps) not in (1, 3) or min(steps) < 1:
                raise ValueError("must be a number of at least 1, or three")
            return dilation

    @property
    def title(self) -> str:
        rings, dilation = self.settings.rings, self.settings.dilation
        text = f"spirals of {f'{rings} rings' if rings else f'{self.length} vertices'}"
        if dilation != 1:
            text += f", dilation {', '.join(map(str, self._steps))}"
        return text + start_title(self.settings)

    @property
    def length(self) -> int | None:
        return None if self.settings.rings else self.settings.seq_len

    @property
    def length_label(self) -> str:
        return f"{self.settings.rings} rings" if self.settings.rings else f"N = {self.length}"

    @property
    def least_vertices(self) -> int:
        return self._reach or 1

    @property
    def _steps(self) -> list[int]:
        dilation = self.settings.dilation
        return dilation if isinstance(dilation, list) else [dilation]

    @property
    def _reach(self) -> int | None:
        """Number of vertices of the spiral from which the elements are taken."""
        return None if self.length is None else 1 + (self.length - 1) * max(self._steps)

    def mesh_key(self, mesh: Mesh) -> tuple:
        """The one-rings: meshes with equal connectivity share one table."""
        return connectivity.one_rings(mesh)

    def compute(self, mesh: Mesh, frames: np.ndarray | None = None) -> Arrays:
        """`sequences` and `first` of a `SpiralTable`."""
        table = spirals.spiral_table(mesh, self._reach, rings=self.settings.rings)
        sequences = table.sequences
        if len(self._steps) == 1:
            sequences = np.ascontiguousarray(sequences[:, :: self._steps[0]])
        return {"sequences": sequences, "first": table.first}

    def tensors(
        self, arrays: Arrays, mesh: Mesh, frames: np.ndarray | None = None
    ) -> dict[str, Any]:
        tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
        if frames is not None:
            tensors["starts"] = torch.from_numpy(nearest_neighbours(mesh, frames[:, 0]))
        return tensors

    def draw(self, batch: Batch, generator: torch.Generator, training: bool = False) -> Batch:
        batch = dict(batch)
        sequences, first = batch.pop("sequences"), batch.pop("first")
        jitter = self.settings.jitter if training else 0
        pooled = self.settings.pooled
        starts = draw_starts(first.diff(), batch.pop("starts", None), jitter, generator, pooled)
        rows = (first[:-1, None] + starts).flatten()
        drawn = sequences.index_select(0, rows).long().unflatten(0, starts.shape)
        drawn = drawn.squeeze(1) if pooled == 1 else drawn
        if len(self._steps) > 1:
            drawn = tuple(drawn[..., ::step][..., : self.length] for step in self._steps)
        batch["spirals"] = drawn
        return batch
