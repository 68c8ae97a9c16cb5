"""The same surface with about so many vertices, for a network that knows one density of vertices.

Fewer by VTK's quadric edge collapses (Garland, Heckbert 1997; Hoppe 1999), more by cutting every
triangle into four first.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh

from meshspiral.geometry.mesh import Mesh, MeshError, in_use
from meshspiral.geometry.remesh import closest_points

POINTS = 20_000  # looked up at a time


class Resampled(NamedTuple):
    """A mesh, and where on it the vertices of the source lie.

    corners: int64 [V, 3], the vertices of a face of `mesh`. weights: float64 [V, 3], barycentric
    coordinates in it.
    """

    mesh: Mesh
    corners: np.ndarray
    weights: np.ndarray


def resample(mesh: Mesh, vertices: int) -> Resampled:
    """The surface with about so many vertices. Vertices without a face have no part in it.

    Errors: MeshError if nothing of the surface would be left.
    """
    import pyvista  # takes a second

    used, faces = in_use(mesh.faces)
    points = mesh.vertices[used]
    while len(points) < vertices:
        points, faces = trimesh.remesh.subdivide(points, faces)
    surface = pyvista.make_tri_mesh(np.ascontiguousarray(points), faces)
    share = 1.0 - vertices / len(points)
    if share > 0:
        surface = surface.decimate(share)
    points, faces = np.asarray(surface.points, dtype=np.float64), surface.regular_faces
    faces = without_repeats(faces)
    while len(faces) and len(extra := surplus(faces, len(points))):
        faces = np.delete(faces, extra, axis=0)
    used, faces = in_use(faces)
    if len(used) < 4:
        raise MeshError(f"{mesh.name}: nothing is left of it with {vertices} vertices")
    coarse = Mesh(points[used], faces, mesh.name)
    parts = [
        closest_points(
            coarse,
            mesh.vertices[start : start + POINTS],
            mesh.vertex_normals[start : start + POINTS],
        )[:2]
        for start in range(0, len(mesh.vertices), POINTS)
    ]
    on, weights = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Resampled(coarse, coarse.faces[on].astype(np.int64), weights)


def without_repeats(faces: np.ndarray) -> np.ndarray:
    """The faces [F, 3] that name three vertices, each triple once."""
    ordered = np.sort(faces, axis=1)
    proper = (ordered[:, 0] < ordered[:, 1]) & (ordered[:, 1] < ordered[:, 2])
    _, first = np.unique(ordered[proper], axis=0, return_index=True)
    return faces[proper][np.sort(first)]


def surplus(faces: np.ndarray, vertices: int) -> np.ndarray:
    """Faces [K] that are one too many at an edge: a third face, or the second in one direction."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    directed = edges[:, 0] * vertices + edges[:, 1]
    _, first = np.unique(directed, return_index=True)
    repeated = np.setdiff1d(np.arange(len(directed)), first)
    return np.unique(repeated // 3)
