"""Connectivity of a mesh: the clockwise one-ring and the fans of every vertex."""

from __future__ import annotations

import numpy as np
from numba import njit

from meshspiral.geometry.mesh import Mesh

OPEN, CLOSED = 1, 2  # kinds of fans


def one_rings(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """The neighbours of every vertex, clockwise as seen from outside (against the faces' winding).

    The ring of an inner vertex is a cycle with an arbitrary first neighbour. The ring of a boundary
    vertex is an open fan, from one boundary edge to the other. An isolated vertex has none.

    At a bow tie, a vertex where several fans meet, the fans follow one another, each clockwise. A
    closed fan begins with the neighbour nearest to the vertex; the fans are sorted by the distance
    of their first neighbour. This order does not depend on the numbering of vertices or faces.

    Args:
        mesh: The surface.

    Returns:
        The neighbours, int32 [E], and the start of every ring, int64 [V+1]: the one-ring of v is
        neighbours[first[v]:first[v+1]]. E is the number of directed edges.
    """
    neighbours, first, fan_kinds = _one_rings(mesh.faces, len(mesh.vertices))
    for v in np.flatnonzero(_fan_counts(first, fan_kinds) > 1):
        ring_slice = slice(first[v], first[v + 1])
        ring, kinds = neighbours[ring_slice], fan_kinds[ring_slice]
        distance = ((mesh.vertices[ring] - mesh.vertices[v]) ** 2).sum(axis=1)
        parts = np.split(np.arange(len(ring)), np.flatnonzero(kinds)[1:])
        parts = [
            np.roll(part, -distance[part].argmin()) if kinds[part[0]] == CLOSED else part
            for part in parts
        ]
        parts.sort(key=lambda part: distance[part[0]])
        neighbours[ring_slice] = ring[np.concatenate(parts)]
    return neighbours, first


def fans(mesh: Mesh) -> np.ndarray:
    """The number of fans of every vertex.

    Args:
        mesh: The surface.

    Returns:
        int64 [V]: 1 where the surface is manifold, more at a bow tie, 0 at an isolated vertex.
    """
    _, first, fan_kinds = _one_rings(mesh.faces, len(mesh.vertices))
    return _fan_counts(first, fan_kinds)


def _fan_counts(first: np.ndarray, fan_kinds: np.ndarray) -> np.ndarray:
    """The number of fans of every vertex, int64 [V], from the output of `_one_rings`."""
    return np.diff(np.concatenate([[0], np.cumsum(fan_kinds > 0)])[first])


@njit(cache=True)
def _one_rings(faces, count):
    """The one-rings, with the fans of a bow tie in arbitrary order.

    Args:
        faces: int32 [F, 3].
        count: Number of vertices.

    Returns:
        neighbours and first, as `one_rings` returns them; and fan_kinds, int8 [E]: OPEN or CLOSED
        at the first neighbour of a fan, 0 at all others.
    """
    corner_first = np.zeros(count + 1, np.int64)
    for face in faces:
        for v in face:
            corner_first[v + 1] += 1
    for v in range(count):
        corner_first[v + 1] += corner_first[v]
    fill = corner_first[:-1].copy()
    source = np.empty(faces.size, np.int32)  # around a corner, clockwise leads from source ...
    target = np.empty(faces.size, np.int32)  # ... to target, across the corner's face
    for face in faces:
        for i in range(3):
            a, b, c = face[i], face[(i + 1) % 3], face[(i + 2) % 3]
            source[fill[a]], target[fill[a]] = c, b
            fill[a] += 1

    neighbours = np.empty(2 * faces.size, np.int32)
    fan_kinds = np.zeros(2 * faces.size, np.int8)
    first = np.zeros(count + 1, np.int64)
    after = np.empty(count, np.int32)  # the neighbour clockwise after x, valid if has_after[x] == v
    has_after = np.full(count, -1, np.int32)  # the last vertex for which after[x] was set
    has_before = np.full(count, -1, np.int32)
    listed = np.full(count, -1, np.int32)
    end = 0
    for v in range(count):
        first[v] = end
        corners = range(corner_first[v], corner_first[v + 1])
        for k in corners:
            after[source[k]] = target[k]
            has_after[source[k]] = v
            has_before[target[k]] = v
        for kind in (OPEN, CLOSED):  # open fans first: every neighbour left is in a closed one
            for k in corners:
                x = source[k]
                if listed[x] == v or (kind == OPEN and has_before[x] == v):
                    continue
                fan_kinds[end] = kind
                while listed[x] != v:
                    listed[x] = v
                    neighbours[end] = x
                    end += 1
                    if has_after[x] == v:
                        x = after[x]
    first[count] = end
    return neighbours[:end].copy(), first, fan_kinds[:end]
