"""The spiral operator (Lim, Dielen, Campen, Kobbelt 2018, section 3.1).

A spiral writes out the neighbourhood of a vertex v: v itself, its one-ring clockwise, its two-ring,
and so on. With the k-ring of v, 0-ring = {v}, (k+1)-ring = N(k-ring) without the k-disk:

- the one-ring is clockwise, from a start that is free;
- of two vertices of the (k+1)-ring that share a neighbour in the k-ring, the one that comes first
  clockwise around it comes first; if they share none, they keep the order of their neighbours.

It ends after exactly N vertices, or with the k-th ring.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from meshspiral.geometry.connectivity import one_rings
from meshspiral.geometry.mesh import Mesh


@dataclass(frozen=True, eq=False)
class SpiralTable:
    """The spirals of all starts of all vertices of a mesh.

    sequences: int32 [R, N], vertex indices, -1 where the component has no more vertices.
    first: int64 [V+1]; the rows of vertex v are first[v]:first[v+1], one per start, clockwise.

    A spiral depends on nothing but its first step, so there is one row for each directed edge;
    a vertex without neighbours has the one row [v, -1, ...].
    """

    sequences: np.ndarray
    first: np.ndarray


def spiral_table(mesh: Mesh, length: int | None = None, *, rings: int | None = None) -> SpiralTable:
    """Every spiral of a mesh, of `length` vertices or of `rings` whole rings.

    With `length` N the table is [R, N]. With `rings` k the spirals differ in length; the table is
    as wide as the longest and padded with -1.

    At a boundary vertex the ring is an open fan: a start inside the fan goes on over the gap. Rings
    that are partial, fall into pieces or meet themselves list each vertex once. Where several fans
    meet in one vertex, they follow one another as in `one_rings`. The sequences do not depend on
    the numbering of the mesh; only where the rows of a vertex begin does.

    Errors: ValueError unless exactly one of length >= 1 and rings >= 0 is given.
    """
    if (length is None) == (rings is None):
        raise ValueError("give either length or rings, not both and not neither")
    if length is not None and length < 1:
        raise ValueError(f"length must be at least 1, got {length}")
    if rings is not None and rings < 0:
        raise ValueError(f"rings must be at least 0, got {rings}")
    neighbours, ring_first = one_rings(mesh)
    rows_first = np.zeros_like(ring_first)
    np.cumsum(np.maximum(np.diff(ring_first), 1), out=rows_first[1:])
    if length is None:
        length = _longest(neighbours, ring_first, rings)
    depth = np.iinfo(np.int32).max if rings is None else rings
    sequences = np.full((rows_first[-1], length), -1, dtype=np.int32)
    _fill(neighbours, ring_first, rows_first, depth, sequences)
    return SpiralTable(sequences, rows_first)


@njit(cache=True)
def _spiral(v, start, neighbours, first, max_depth, seen, mark, out, parent, depth):
    """Write the spiral of v whose first step is its neighbour number `start`; return its length.

    The sequence is walked as a queue. Vertex u, with w before it, appends its unseen neighbours
    clockwise from just after w: where the rings are whole, each step then leads to a neighbour.
    If w is no neighbour of u, it begins after the vertex that appended u, which always is one.
    """
    out[0], parent[0], depth[0] = v, 0, 0
    seen[v] = mark
    end, i = 1, 0
    while i < end < len(out) and depth[i] < max_depth:
        u = out[i]
        base, valence = first[u], first[u + 1] - first[u]
        after = start - 1
        if i > 0:
            after = -1
            for k in range(valence):
                if neighbours[base + k] == out[i - 1]:
                    after = k
                    break
                if neighbours[base + k] == out[parent[i]]:
                    after = k
        for k in range(after + 1, after + 1 + valence):
            x = neighbours[base + k % valence]
            if seen[x] != mark and end < len(out):
                out[end], parent[end], depth[end] = x, i, depth[i] + 1
                seen[x] = mark
                end += 1
        i += 1
    return end


@njit(cache=True)
def _fill(neighbours, first, rows_first, max_depth, sequences):
    length = sequences.shape[1]
    seen = np.full(len(first) - 1, -1, np.int64)
    parent, depth = np.empty(length, np.int32), np.empty(length, np.int32)
    for v in range(len(first) - 1):
        for row in range(rows_first[v], rows_first[v + 1]):
            _spiral(
                v,
                row - rows_first[v],
                neighbours,
                first,
                max_depth,
                seen,
                row,
                sequences[row],
                parent,
                depth,
            )


@njit(cache=True)
def _longest(neighbours, first, rings):
    """The largest number of vertices within `rings` rings of any vertex."""
    count = len(first) - 1
    seen = np.full(count, -1, np.int64)
    out, parent, depth = (
        np.empty(count, np.int32),
        np.empty(count, np.int32),
        np.empty(count, np.int32),
    )
    longest = 1
    for v in range(count):
        end = _spiral(v, 0, neighbours, first, rings, seen, v, out, parent, depth)
        longest = max(longest, end)
    return longest
