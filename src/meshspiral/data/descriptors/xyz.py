"""Positions as features, for comparison."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from meshspiral.data.descriptors.base import Descriptor
from meshspiral.data.settings import Strict
from meshspiral.geometry.mesh import Mesh

if TYPE_CHECKING:
    import torch  # takes seconds; the command line knows descriptors without it


class Xyz(Descriptor, name="xyz"):
    """The position relative to the mean of all vertices, over the square root of the surface area.

    Not invariant: it changes when the mesh is rotated. A network that reads positions recognises
    poses and orientations of the training data, unless these are rotated in every iteration.
    """

    channels = 3

    class Settings(Strict):
        rotate: bool = Field(
            description="rotate each training mesh at random, anew in every iteration"
        )

    def compute(self, mesh: Mesh, frames: np.ndarray | None = None) -> np.ndarray:
        return (mesh.centred / (np.sqrt(544) * mesh.size)).astype(np.float32)

    def drawn(self, features: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        if not self.settings.rotate:
            return features
        return features @ random_rotation(generator).to(features)


def random_rotation(generator: torch.Generator) -> torch.Tensor:
    """A rotation, uniform among all, float64 [3, 3] (of a random unit quaternion)."""
    import torch

    q = torch.randn(4, generator=generator, device=generator.device, dtype=torch.float64)
    return torch.from_numpy(Rotation.from_quat(q.cpu().numpy()).as_matrix())
