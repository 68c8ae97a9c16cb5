"""Resampling of a surface to a given number of vertices.

A network knows the density of vertices that it was trained on. To have fewer vertices, VTK
collapses edges by quadrics (Garland, Heckbert 1997; Hoppe 1999). To have more, every triangle is
first cut into four.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh

from meshspiral.geometry.faces import surplus, without_repeats
from meshspiral.geometry.mesh import Mesh, MeshError, used_vertices
from meshspiral.geometry.remesh import closest_points

POINTS = 20_000  # points projected at a time


class Resampled(NamedTuple):
    """A resampled mesh, and the closest point on it of every vertex of the source.

    Attributes:
        mesh: The resampled surface.
        corners: int64 [V, 3], the vertices of the face of `mesh` that the point lies in.
        weights: float64 [V, 3], the barycentric coordinates of the point in that face.
    """

    mesh: Mesh
    corners: np.ndarray
    weights: np.ndarray


def resample(mesh: Mesh, vertices: int) -> Resampled:
    """Resample a surface, and find where on it the vertices of the source lie.

    Args:
        mesh, vertices: As for `resampled`, whose errors it raises.
    """
    coarse = resampled(mesh, vertices)
    projections = [
        closest_points(
            coarse,
            mesh.vertices[start : start + POINTS],
            mesh.vertex_normals[start : start + POINTS],
        )[:2]
        for start in range(0, len(mesh.vertices), POINTS)
    ]
    face, weights = (np.concatenate(column) for column in zip(*projections, strict=True))
    return Resampled(coarse, coarse.faces[face].astype(np.int64), weights)


def resampled(mesh: Mesh, vertices: int) -> Mesh:
    """Resample a surface to approximately a given number of vertices.

    Args:
        mesh: The source. Its isolated vertices do not contribute to the result.
        vertices: The number of vertices wanted.

    Raises:
        MeshError: The mesh has no face, or nothing of the surface would be left.
    """
    import pyvista  # slow to import: one second

    if not len(mesh.faces):
        raise MeshError(f"{mesh.name}: no faces, so there is no surface to resample")
    used, faces = used_vertices(mesh.faces)
    points = mesh.vertices[used]
    while len(points) < vertices:
        points, faces = trimesh.remesh.subdivide(points, faces)
    surface = pyvista.make_tri_mesh(np.ascontiguousarray(points), faces)
    reduction = 1.0 - vertices / len(points)
    if reduction > 0:
        surface = surface.decimate(reduction)
    points, faces = np.asarray(surface.points, dtype=np.float64), surface.regular_faces
    faces = without_repeats(faces)
    while len(faces) and len(extra := surplus(faces, len(points))):
        faces = np.delete(faces, extra, axis=0)
    used, faces = used_vertices(faces)
    if len(used) < 4:
        raise MeshError(
            f"{mesh.name}: nothing is left of the surface when it is resampled to "
            f"{vertices} vertices"
        )
    return Mesh(points[used], faces, mesh.name, mesh.complete_area)
