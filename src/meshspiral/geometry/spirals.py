"""Spirals around vertices (Lim, Dielen, Campen, Kobbelt 2018, section 3.1).

A spiral orders the neighbourhood of a vertex v into a sequence: v itself, its one-ring clockwise,
its two-ring, and so on. The 0-ring of v is {v}; the (k+1)-ring is the set of neighbours of the
k-ring outside the k-disk.

- The one-ring is clockwise, from a start that may be any neighbour.
- Two vertices of the (k+1)-ring with a common neighbour in the k-ring stand in their clockwise
  order around it. Two without a common neighbour stand in the order of their neighbours.

A spiral ends after exactly N vertices, or with the k-th ring.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from meshspiral.geometry.connectivity import one_rings
from meshspiral.geometry.mesh import Mesh


@dataclass(frozen=True, eq=False)
class SpiralTable:
    """The spirals of all vertices of a mesh, from all starts.

    A spiral is determined by its first step, so the table has one row per directed edge. An
    isolated vertex v has the single row [v, -1, ...].

    Attributes:
        sequences: int32 [R, N], vertex indices; -1 after the last vertex of a spiral.
        first: int64 [V+1]; the rows of vertex v are first[v]:first[v+1], one per start, clockwise.
    """

    sequences: np.ndarray
    first: np.ndarray


def spiral_table(mesh: Mesh, length: int | None = None, *, rings: int | None = None) -> SpiralTable:
    """All spirals of a mesh, one per vertex and start (Lim et al. 2018, section 3.1).

    The one-ring of a boundary vertex is an open fan; a spiral that starts inside the fan continues
    at its other end. The fans of a bow tie follow one another as in `one_rings`. Rings that are
    incomplete, fall into pieces or meet themselves list every vertex once.

    Args:
        mesh: The surface; boundaries, bow ties and several components are allowed.
        length: Number of vertices N of every spiral. Give either this or `rings`.
        rings: Number of complete rings k; the spirals then differ in length, and N is the longest.

    Returns:
        The table. Spirals are padded with -1, also where a component has fewer than N vertices. The
        sequences do not depend on the numbering of the mesh; which row of a vertex comes first
        does.

    Raises:
        ValueError: Neither or both of `length` and `rings` are given, `length` is below 1, or
            `rings` is below 0.
    """
    if (length is None) == (rings is None):
        given = "neither" if length is None else f"length={length} and rings={rings}"
        raise ValueError(f"give either length or rings, got {given}")
    if length is not None and length < 1:
        raise ValueError(f"length must be at least 1, got {length}")
    if rings is not None and rings < 0:
        raise ValueError(f"rings must be at least 0, got {rings}")
    neighbours, ring_first = one_rings(mesh)
    rows_first = np.zeros_like(ring_first)
    np.cumsum(np.maximum(np.diff(ring_first), 1), out=rows_first[1:])
    if length is None:
        length = _longest(neighbours, ring_first, rings)
    max_depth = np.iinfo(np.int32).max if rings is None else rings
    sequences = np.full((rows_first[-1], length), -1, dtype=np.int32)
    _fill(neighbours, ring_first, rows_first, max_depth, sequences)
    return SpiralTable(sequences, rows_first)


@njit(cache=True)
def _spiral(v, start, neighbours, first, max_depth, seen, mark, out, parent, depth):
    """Write one spiral.

    The sequence is processed as a queue. Vertex u, with w before it in the sequence, appends its
    unseen neighbours clockwise from just after w: where the rings are complete, every step then
    leads to a neighbour. If w is not a neighbour of u, it begins after the vertex that appended u,
    which always is one.

    Args:
        v: The centre.
        start: Position in v's one-ring of the first step.
        neighbours, first: The one-rings, as `one_rings` returns them.
        max_depth: Number of rings.
        seen: int64 [V], a mark for every vertex; this spiral sets those of its vertices to `mark`.
        mark: A number that no spiral before has used.
        out: int32 [N], receives the spiral.
        parent: int32 [N], receives the position of the vertex that appended each.
        depth: int32 [N], receives the ring of each.

    Returns:
        The number of vertices written.
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
    """Write the spirals of all vertices into sequences, int32 [R, N]."""
    length = sequences.shape[1]
    seen = np.full(len(first) - 1, -1, np.int64)
    parent, depth = np.empty(length, np.int32), np.empty(length, np.int32)
    for v in range(len(first) - 1):
        for row in range(rows_first[v], rows_first[v + 1]):
            start, out = row - rows_first[v], sequences[row]
            _spiral(v, start, neighbours, first, max_depth, seen, row, out, parent, depth)


@njit(cache=True)
def _longest(neighbours, first, rings):
    """The largest number of vertices within `rings` rings of any vertex."""
    count = len(first) - 1
    seen = np.full(count, -1, np.int64)
    out = np.empty(count, np.int32)
    parent, depth = np.empty_like(out), np.empty_like(out)
    longest = 1
    for v in range(count):
        end = _spiral(v, 0, neighbours, first, rings, seen, v, out, parent, depth)
        longest = max(longest, end)
    return longest
