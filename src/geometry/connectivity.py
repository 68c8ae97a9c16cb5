"""Who stands around whom: the clockwise one-ring of every vertex."""

from __future__ import annotations

import numpy as np
from numba import njit

from src.geometry.mesh import Mesh


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
    return _one_rings(mesh.faces, mesh.vertices)


@njit(cache=True)
def _one_rings(faces, vertices):
    count = len(vertices)
    corner_first = np.zeros(count + 1, np.int64)
    for face in faces:
        for v in face:
            corner_first[v + 1] += 1
    corner_first = np.cumsum(corner_first)
    fill = corner_first[:-1].copy()
    source = np.empty(faces.size, np.int32)  # at a corner, clockwise leads from source ...
    target = np.empty(faces.size, np.int32)  # ... to target, across the corner's face
    for face in faces:
        for i in range(3):
            a, b, c = face[i], face[(i + 1) % 3], face[(i + 2) % 3]
            source[fill[a]], target[fill[a]] = c, b
            fill[a] += 1

    neighbours = np.empty(2 * faces.size, np.int32)
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
        fans = 0
        for begins_open in (True, False):  # open fans first: what they leave is closed
            for k in corners:
                x = source[k]
                if listed[x] == v or (begins_open and has_before[x] == v):
                    continue
                fans += 1
                while listed[x] != v:
                    listed[x] = v
                    neighbours[end] = x
                    end += 1
                    if has_after[x] == v:
                        x = after[x]
        if fans > 1:
            _order_fans(neighbours[first[v] : end], v, vertices, has_after, has_before, after)
    first[count] = end
    return neighbours[:end].copy(), first


@njit(cache=True)
def _order_fans(ring, v, vertices, has_after, has_before, after):
    """Sort in place a ring that holds several fans, each contiguous, as `one_rings` says."""
    distance = np.empty(len(ring))
    for i, x in enumerate(ring):
        distance[i] = np.sum((vertices[x] - vertices[v]) ** 2)
    starts, stops, entries = [0], [0], [0]
    starts.clear(), stops.clear(), entries.clear()
    i = 0
    while i < len(ring):
        j = i + 1
        while j < len(ring) and has_after[ring[j - 1]] == v and after[ring[j - 1]] == ring[j]:
            j += 1
        closed = has_before[ring[i]] == v
        starts.append(i), stops.append(j)
        entries.append(i + np.argmin(distance[i:j]) if closed else i)
        i = j
    old = ring.copy()
    end = 0
    for fan in np.argsort(np.array([distance[e] for e in entries])):
        start, length = starts[fan], stops[fan] - starts[fan]
        for k in range(length):
            ring[end] = old[start + (entries[fan] - start + k) % length]
            end += 1
