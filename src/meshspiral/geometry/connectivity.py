"""Who stands around whom: the clockwise one-ring of every vertex."""

from __future__ import annotations

import numpy as np
from numba import njit

from meshspiral.geometry.mesh import Mesh

OPEN, CLOSED = 1, 2  # kinds of fans


def one_rings(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """The neighbours of every vertex, clockwise as seen from outside (against the faces' winding).

    Returns (neighbours int32 [E], first int64 [V+1]); the one-ring of v is
    neighbours[first[v]:first[v+1]], and E counts directed edges. An inner vertex's ring is a cycle
    and begins anywhere; a boundary vertex's ring is an open fan, from one boundary edge to the
    other. A vertex without a face has none.

    Where several fans meet in one vertex (a bow tie), they are listed one after another, each
    clockwise: a closed fan from the neighbour nearest to the vertex, the fans in the order of the
    distance of their first neighbour. Nothing depends on the numbering of vertices or faces.
    """
    neighbours, first, begins = _one_rings(mesh.faces, len(mesh.vertices))
    for v in np.flatnonzero(_fans(first, begins) > 1):
        here = slice(first[v], first[v + 1])
        ring, begin = neighbours[here], begins[here]
        distance = ((mesh.vertices[ring] - mesh.vertices[v]) ** 2).sum(axis=1)
        parts = np.split(np.arange(len(ring)), np.flatnonzero(begin)[1:])
        parts = [
            np.roll(part, -distance[part].argmin()) if begin[part[0]] == CLOSED else part
            for part in parts
        ]
        parts.sort(key=lambda part: distance[part[0]])
        neighbours[here] = ring[np.concatenate(parts)]
    return neighbours, first


def fans(mesh: Mesh) -> np.ndarray:
    """The number of fans that the faces at every vertex make, int64 [V]: 1 where the surface is
    manifold, more at a bow tie, 0 without a face."""
    _, first, begins = _one_rings(mesh.faces, len(mesh.vertices))
    return _fans(first, begins)


def _fans(first: np.ndarray, begins: np.ndarray) -> np.ndarray:
    return np.diff(np.concatenate([[0], np.cumsum(begins > 0)])[first])


@njit(cache=True)
def _one_rings(faces, count):
    """Neighbours and first as `one_rings` gives them, but for the order of several fans; and
    begins int8 [E]: OPEN or CLOSED where a fan of this kind begins, else 0."""
    corner_first = np.zeros(count + 1, np.int64)
    for face in faces:
        for v in face:
            corner_first[v + 1] += 1
    for v in range(count):
        corner_first[v + 1] += corner_first[v]
    fill = corner_first[:-1].copy()
    source = np.empty(faces.size, np.int32)  # at a corner, clockwise leads from source ...
    target = np.empty(faces.size, np.int32)  # ... to target, across the corner's face
    for face in faces:
        for i in range(3):
            a, b, c = face[i], face[(i + 1) % 3], face[(i + 2) % 3]
            source[fill[a]], target[fill[a]] = c, b
            fill[a] += 1

    neighbours = np.empty(2 * faces.size, np.int32)
    begins = np.zeros(2 * faces.size, np.int8)
    first = np.zeros(count + 1, np.int64)
    after = np.empty(count, np.int32)
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
        for kind in (OPEN, CLOSED):  # open fans first: what they leave is closed
            for k in corners:
                x = source[k]
                if listed[x] == v or (kind == OPEN and has_before[x] == v):
                    continue
                begins[end] = kind
                while listed[x] != v:
                    listed[x] = v
                    neighbours[end] = x
                    end += 1
                    if has_after[x] == v:
                        x = after[x]
    first[count] = end
    return neighbours[:end].copy(), first, begins[:end]
