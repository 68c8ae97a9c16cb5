"""Positions as features, for comparison."""

from __future__ import annotations

import numpy as np

from meshspiral.data.descriptors.base import Descriptor
from meshspiral.geometry.mesh import Mesh


class Xyz(Descriptor, name="xyz"):
    """The position relative to the mean of all vertices, over the square root of the surface area.

    Not invariant: it changes when the mesh is rotated. A network that reads positions recognises
    poses and orientations of the training data.
    """

    channels = 3

    def compute(self, mesh: Mesh, frames: np.ndarray | None = None) -> np.ndarray:
        return (mesh.centred / (np.sqrt(544) * mesh.size)).astype(np.float32)
