"""Closing small holes of a surface, with faces between the vertices that it has."""

from __future__ import annotations

import numpy as np
from numba import njit

from meshspiral.geometry.faces import directed_edges
from meshspiral.geometry.mesh import Mesh

HOLE = 0.1  # largest hole closed: as long as a circle of this radius over `Mesh.size`
FLAT = 1e-12  # largest area of a slit, over the surface area
OUTSIDE = -0.5  # cosine below which the inside of a loop faces away from the surface around it


def close_holes(mesh: Mesh, radius: float = HOLE) -> Mesh:
    """Close the holes whose boundary is no longer than a circle of some radius.

    A hole gets the triangulation of least area (Barequet, Sharir 1995). It stays open if every
    triangulation needs an edge that the mesh already has, if it has no area, as a slit, or if the
    boundary is the rim of a small piece of surface.

    Args:
        mesh: The surface.
        radius: Of the circle, over `mesh.size`.

    Returns:
        The mesh, its own faces followed by those that close holes.
    """
    if not 0 < mesh.size < np.inf:
        return mesh
    count = len(mesh.vertices)
    edges = directed_edges(mesh.faces).astype(np.int64)
    rim = _boundary(edges, count)
    if not len(rim):
        return mesh
    taken = set((edges.min(axis=1) * count + edges.max(axis=1)).tolist())
    normals = mesh.face_normals[rim // 3] / mesh.size**2
    beside = dict(zip(map(tuple, edges[rim, ::-1].tolist()), normals, strict=True))
    added = []
    for loop in boundary_loops(mesh.faces):
        points = (mesh.vertices[loop] - mesh.vertices[loop[0]]) / mesh.size
        steps = np.roll(points, -1, axis=0) - points
        if np.linalg.norm(steps, axis=1).sum() > 2 * np.pi * radius:
            continue
        inside = np.cross(points, steps).sum(axis=0)  # normal, twice the area long
        around = sum(
            beside[edge] for edge in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True)
        )
        if inside @ around < OUTSIDE * np.linalg.norm(inside) * np.linalg.norm(around):
            continue
        low, high = np.minimum.outer(loop, loop), np.maximum.outer(loop, loop)
        keys = low * count + high
        free = np.array([key not in taken for key in keys.ravel().tolist()]).reshape(keys.shape)
        corners, area = _least_area(points, free)
        if FLAT < area < np.inf:
            taken.update(keys[corners, np.roll(corners, -1, axis=1)].ravel().tolist())
            added.append(loop[corners])
    return mesh.with_faces(np.concatenate([mesh.faces, *added])) if added else mesh


def has_large_holes(mesh: Mesh) -> bool:
    """Whether all boundaries together are longer than the largest hole that is closed."""
    return boundary_length(mesh) > 2 * np.pi * HOLE * mesh.size


def boundary_length(mesh: Mesh) -> float:
    """The length of all boundaries, in the mesh's unit."""
    edges = directed_edges(mesh.faces).astype(np.int64)
    start, tip = edges[_boundary(edges, len(mesh.vertices))].T
    return float(np.linalg.norm(mesh.vertices[start] - mesh.vertices[tip], axis=1).sum())


def _boundary(edges: np.ndarray, count: int) -> np.ndarray:
    """The edges with a face on one side only, as rows of `edges`, int64 [E, 2], directed."""
    return np.flatnonzero(~np.isin(edges[:, 1] * count + edges[:, 0], edges @ [count, 1]))


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """The boundaries of a surface, each vertex once in a loop.

    Faces that fill a loop are wound in its direction. At a bow tie a loop goes from one edge of a
    fan to the other edge of the same fan.

    Args:
        faces: int [F, 3], wound alike.

    Returns:
        The vertices of each loop, int64.
    """
    edges = directed_edges(faces).astype(np.int64)
    opposite = np.roll(faces, -2, axis=1).ravel().tolist()
    third = dict(zip(map(tuple, edges.tolist()), opposite, strict=True))
    after = {}  # (start, tip) of an edge along a hole: the edge that follows
    for start, tip in third:
        if (tip, start) not in third:
            edge = (start, tip)  # the hole's edge leads from tip to start; turn around start
            while edge in third:
                edge = (start, third[edge])
            after[tip, start] = edge
    loops = []
    while after:
        path: list[int] = []
        place: dict[int, int] = {}
        start, tip = next(iter(after))
        while (start, tip) in after:
            if start in place:  # the path met itself: what lies between is a loop
                first = place[start]
                loops.append(np.array(path[first:]))
                for vertex in path[first:]:
                    del place[vertex]
                del path[first:]
            place[start] = len(path)
            path.append(start)
            start, tip = after.pop((start, tip))
        loops.append(np.array(path))
    return loops


@njit(cache=True)
def _least_area(points, free):
    """The triangulation of a polygon with the least area.

    Args:
        points: float64 [N, 3].
        free: bool [N, N], whether a new edge may join two points; those of the polygon may.

    Returns:
        The triangles, int64 [N - 2, 3], and their area; infinite if there is none.
    """
    n = len(points)
    least, split = np.zeros((n, n)), np.zeros((n, n), np.int64)
    for gap in range(2, n):
        for i in range(n - gap):
            j = i + gap
            best = np.inf
            if free[i, j] or gap == n - 1:
                for k in range(i + 1, j):
                    normal = np.cross(points[k] - points[i], points[j] - points[i])
                    cost = least[i, k] + least[k, j] + np.sqrt((normal * normal).sum()) / 2
                    if cost < best:
                        best, split[i, j] = cost, k
            least[i, j] = best
    corners = np.zeros((n - 2, 3), np.int64)
    if np.isfinite(least[0, n - 1]):
        spans, found = [(0, n - 1)], 0
        while spans:
            i, j = spans.pop()
            if j - i > 1:
                k = split[i, j]
                corners[found, 0], corners[found, 1], corners[found, 2] = i, k, j
                found += 1
                spans.append((i, k))
                spans.append((k, j))
    return corners, least[0, n - 1]
