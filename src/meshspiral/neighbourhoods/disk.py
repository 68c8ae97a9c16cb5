"""Geodesic disks, the neighbourhoods of MoNet (Monti et al. 2017)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from pydantic import Field

from meshspiral.geometry import disks, sampling
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.shot import Frame
from meshspiral.neighbourhoods.base import Arrays, Neighbourhood


class Disk(Neighbourhood, name="disk"):
    """The vertices within a geodesic radius, with their polar coordinates.

    Gives `disks`, the fields of `meshspiral.nn.gaussian.Disks`. Angles are measured from the x axis
    of the vertex's local frame, which repeats over poses; where that is undefined, from an
    arbitrary direction.
    """

    gives, noun = "disks", "geodesic disks"
    density_range = 4.0  # the radius follows the surface, not the edges

    class Settings(Neighbourhood.Settings):
        radius: float = Field(
            gt=0, description="radius of a disk over the square root of the surface area"
        )
        max_vertices: int = Field(
            ge=2,
            description="largest number of vertices of a disk, evenly spread in a denser one",
        )
        support: float = Field(
            gt=0, description="radius of the local frame over the square root of the area"
        )

    @property
    def title(self) -> str:
        return f"geodesic disks of radius {self.settings.radius} sqrt(area)"

    @property
    def frame(self) -> Frame:
        return Frame(self.settings.support, by_area=True)

    def compute(self, mesh: Mesh, frames: np.ndarray | None = None) -> Arrays:
        """The table of `geodesic_disks`; distances are over the radius."""
        directions = sampling.surface_directions(mesh, frames[:, 0])
        turn = np.where(np.isfinite(directions), directions, 0.0)
        radius = self.settings.radius * mesh.size
        table = disks.geodesic_disks(mesh, radius, self.settings.max_vertices, turn)._asdict()
        return table | {"distances": table["distances"] / np.float32(radius)}

    def tensors(
        self, arrays: Arrays, mesh: Mesh, frames: np.ndarray | None = None
    ) -> dict[str, Any]:
        names = {"vertices": "indices", "distances": "distances", "angles": "angles"}
        return {"disks": {name: torch.from_numpy(arrays[key]) for name, key in names.items()}}
