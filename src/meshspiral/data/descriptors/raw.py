"""Raw geometry of the neighbourhood (Lim et al. 2018, conclusion)."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from meshspiral.data.descriptors.base import Descriptor
from meshspiral.data.settings import Strict
from meshspiral.geometry import barycentric, sampling
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.shot import Frame


class Raw(Descriptor, name="raw"):
    """Positions, normals, distances and angles at the places of a polar grid around each vertex.

    Positions and normals are in the vertex's local frame, lengths relative to the radius, so
    everything is invariant to rotation, translation and scale. The grid starts where the frame
    points; where the frame is undefined, so is the descriptor.

    Of each of the rings * rays places: position and normal (3 channels each), straight distance
    from the vertex, and angle at the vertex from the place before on its ring; then the normal of
    the vertex itself.
    """

    class Settings(Strict):
        radius: float = Field(
            gt=0, description="radius of the polar grid over the square root of the surface area"
        )
        rings: int = Field(ge=1, description="number of rings of the polar grid")
        rays: int = Field(ge=2, description="number of places of a ring")
        support: float = Field(
            gt=0, description="radius of the local frame over the square root of the area"
        )

    @property
    def channels(self) -> int:
        return 8 * self.settings.rings * self.settings.rays + 3

    @property
    def frame(self) -> Frame:
        return Frame(self.settings.support, by_area=True)

    def compute(self, mesh: Mesh, frames: np.ndarray | None = None) -> np.ndarray:
        rings, rays = self.settings.rings, self.settings.rays
        radius = self.settings.radius * mesh.size
        start = sampling.surface_directions(mesh, frames[:, 0])
        undefined = ~np.isfinite(start)
        grid = np.where(undefined, 0.0, start)
        table = sampling.sampled_places(mesh, radius, rings, rays, grid)
        places = (table.indices[:, 1:], table.weights[:, 1:].astype(np.float64))
        axes = np.swapaxes(frames, 1, 2).astype(np.float64)
        offsets = barycentric.interpolate(mesh.vertices, *places) - mesh.vertices[:, None]
        positions = offsets @ axes / radius
        normals = barycentric.interpolate(mesh.vertex_normals, *places) @ axes
        distances = np.linalg.norm(positions, axis=2, keepdims=True)
        by_ring = positions.reshape(len(positions), rings, rays, 3)
        before = np.roll(by_ring, 1, axis=2)
        sine = np.linalg.norm(np.cross(before, by_ring), axis=3)
        angles = np.arctan2(sine, (before * by_ring).sum(axis=3)).reshape(distances.shape)
        own = (mesh.vertex_normals[:, None] @ axes)[:, 0]
        around = np.concatenate([positions, normals, distances, angles], axis=2)
        rows = np.concatenate([around.reshape(len(around), -1), own], axis=1)
        rows[undefined] = np.nan
        return (rows / np.sqrt(544)).astype(np.float32)
