"""SHOT descriptors (Salti, Tombari, Di Stefano 2014)."""

from __future__ import annotations

import numpy as np

from meshspiral.data.descriptors.base import Descriptor
from meshspiral.data.settings import ShotSettings
from meshspiral.geometry import shot
from meshspiral.geometry.mesh import Mesh


class Shot(Descriptor, name="shot"):
    """Histograms of normals in a local frame: invariant to rotation, translation and scale."""

    Settings = ShotSettings

    @property
    def channels(self) -> int:
        return shot.SECTORS * (self.settings.bins + 1)

    def compute(self, mesh: Mesh, frames: np.ndarray | None = None) -> np.ndarray:
        radius = self.settings.radius * mesh.size
        masses = mesh.vertex_areas if self.settings.by_area else None
        return shot.shot_descriptors(
            mesh.centred, mesh.vertex_normals, radius, self.settings.bins, masses=masses
        )
