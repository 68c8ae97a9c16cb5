"""Geodesic disks: the vertices around each vertex, with their geodesic polar coordinates."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from meshspiral.geometry.connectivity import one_rings
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.patches import check_radius, face_sectors, left_corners
from meshspiral.geometry.windows import polar_coordinates, wrapped


class DiskTable(NamedTuple):
    """The vertices of every disk, the nearest first.

    Attributes:
        indices: int32 [V, K], the vertex itself in column 0; -1 behind the end of a row.
        distances: float32 [V, K], geodesic distances from the vertex, in the mesh's unit; 0 behind
            the end.
        angles: float32 [V, K], directions in radians, in (-pi, pi], as in `geodesic_patches`; 0 for
            the vertex itself and behind the end.
    """

    indices: np.ndarray
    distances: np.ndarray
    angles: np.ndarray


def geodesic_disks(
    mesh: Mesh, radius: float, max_vertices: int, turn: np.ndarray | None = None
) -> DiskTable:
    """The vertices within a geodesic radius, with polar coordinates (Melvaer, Reimers 2012).

    A disk of more than `max_vertices` vertices keeps the vertex itself and others evenly: of those
    ordered by distance, every n-th for a fitting n, the last included.

    Args:
        mesh: The surface.
        radius: In the mesh's unit.
        max_vertices: The largest number of vertices of a disk.
        turn: float [V], radians by which the zero direction of each vertex is turned
            counter-clockwise. None for no turn.

    Returns:
        The table. K is the number of vertices of the largest disk. The disk of a vertex on no face
        is the vertex alone.

    Raises:
        ValueError: `radius` is not positive and finite, or `max_vertices` is below 1.
    """
    check_radius(radius)
    if max_vertices < 1:
        raise ValueError(f"max_vertices must be at least 1, got {max_vertices}")
    neighbours, first = one_rings(mesh)
    left = left_corners(mesh.faces, neighbours, first)
    surface = mesh.vertices, neighbours, first, left
    count = len(mesh.vertices)
    turn = np.zeros(count) if turn is None else np.asarray(turn, dtype=np.float64)
    shape = (count, min(max_vertices, count))
    table = DiskTable(np.full(shape, -1, np.int32), *(np.zeros(shape, np.float32) for _ in "rt"))
    longest = _all_disks(*surface, face_sectors(*surface), turn, float(radius), *table)
    return DiskTable(*(np.ascontiguousarray(array[:, :longest]) for array in table))


@njit(cache=True)
def _all_disks(
    vertices, neighbours, first, left, sectors, turn, radius, indices, distances, angles
):
    """Write the rows of a `DiskTable`, [V, max_vertices]; return the length of the longest."""
    count, max_vertices = indices.shape
    distance, angle = np.full(count, np.inf), np.zeros(count)
    updates, disk = np.zeros(count, np.int32), np.empty(count, np.int32)
    longest = 1
    for v in range(count):
        size = polar_coordinates(
            v, vertices, neighbours, first, left, sectors, radius, distance, angle, updates, disk
        )
        indices[v, 0] = v
        others = disk[1:size]
        order = others[np.argsort(distance[others], kind="mergesort")]
        kept = min(len(order), max_vertices - 1)
        for k in range(kept):
            u = order[(k + 1) * len(order) // kept - 1]
            indices[v, k + 1], distances[v, k + 1] = u, distance[u]
            angles[v, k + 1] = wrapped(angle[u] - turn[v])
        longest = max(longest, kept + 1)
        for u in disk[:size]:
            distance[u] = np.inf
    return longest
