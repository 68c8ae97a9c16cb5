"""Geodesic polar patches (Masci, Boscaini, Bronstein, Vandergheynst 2015).

Around every vertex stands a polar grid on the surface: rings of equal spacing, rays at equal
angles. It is laid out with the exponential map: straightest geodesics (Polthier, Schmies 1998) are
traced from the vertex by unfolding triangle after triangle into the plane, where each is a straight
line. One that wraps round a finger is no longer the shortest; it stays straightest.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from meshspiral.geometry.connectivity import one_rings
from meshspiral.geometry.mesh import Mesh

MOST_FACES = 10_000  # that one ray crosses; only damaged meshes reach it


class PatchTable(NamedTuple):
    """The samples of every vertex's grid, each the weighted sum of three vertices.

    indices: int32 [V, rings, rays, 3]. weights: float32, likewise: barycentric, none negative, of
    sum 1; or all 0, with indices 0, where there is no such sample: the ray has left the surface
    before, or the faces around the vertex have no angles to shoot it into.
    """

    indices: np.ndarray
    weights: np.ndarray

    @property
    def whole(self) -> np.ndarray:
        """bool [V, rings, rays]: which samples there are."""
        return self.weights.any(axis=3)


def geodesic_patches(
    mesh: Mesh, radius: float, rings: int = 5, rays: int = 16, turn: np.ndarray | None = None
) -> PatchTable:
    """The polar grid around every vertex, `rings` x `rays` samples up to distance `radius`.

    Sample (i, j) lies at distance (i + 1) / rings * radius in direction (j + 1/2) 2 pi / rays,
    counter-clockwise as seen from outside. Directions are measured in the angles of the one-ring,
    from an arbitrary neighbour, and rescaled to 2 pi; at a boundary vertex as they are (unless they
    exceed 2 pi), from the last edge clockwise, and the directions outside its faces have no
    samples. Where several fans of faces meet in a vertex, their angles follow one another.

    radius: in the mesh's unit. turn: float [V], radians by which the grid of each vertex is turned
    counter-clockwise; None for none. Errors: ValueError for a radius that is not positive and
    finite, or rings or rays below 1.
    """
    check_grid(radius, rings, rays)
    neighbours, first = one_rings(mesh)
    left = _left(mesh.faces, neighbours, first)
    shape = (len(mesh.vertices), rings, rays, 3)
    indices, weights = np.zeros(shape, np.int32), np.zeros(shape, np.float32)
    for_numba = mesh.vertices, neighbours, first, left
    onward = _onward(neighbours, first, left)
    directions = _directions(*for_numba)
    turn = np.zeros(len(mesh.vertices)) if turn is None else np.asarray(turn, dtype=np.float64)
    _trace_all(*for_numba, onward, directions, turn, float(radius), indices, weights)
    return PatchTable(indices, weights)


def check_grid(radius: float, rings: int, rays: int) -> None:
    """Errors: ValueError for a grid that can't be."""
    if not (np.isfinite(radius) and radius > 0):
        raise ValueError(f"radius must be positive and finite, got {radius}")
    if rings < 1 or rays < 1:
        raise ValueError(f"rings and rays must be at least 1, got {rings} and {rays}")


@njit(cache=True)
def _slot(neighbours, first, a, b):
    """Where the directed edge from a to b stands in `neighbours`."""
    for k in range(first[a], first[a + 1]):
        if neighbours[k] == b:
            return k
    return -1


@njit(cache=True)
def _left(faces, neighbours, first):
    """int32 [E]: for every directed edge the third vertex of the face on its left, -1 if none."""
    left = np.full(len(neighbours), -1, np.int32)
    for face in faces:
        for i in range(3):
            slot = _slot(neighbours, first, face[i], face[(i + 1) % 3])
            left[slot] = face[(i + 2) % 3]
    return left


@njit(cache=True)
def _onward(neighbours, first, left):
    """int32 [E, 2]: for the directed edge from c to b, with d on its left, the directed edges from
    d to b and from c to d: those by which a ray leaves that face, seen from the next one."""
    out = np.full((len(neighbours), 2), -1, np.int32)
    for c in range(len(first) - 1):
        for k in range(first[c], first[c + 1]):
            d = left[k]
            if d >= 0:
                out[k, 0] = _slot(neighbours, first, d, neighbours[k])
                out[k, 1] = _slot(neighbours, first, c, d)
    return out


@njit(cache=True)
def _directions(vertices, neighbours, first, left):
    """float64 [E, 2]: where the face on the left of each directed edge begins and ends around the
    edge's source, counter-clockwise, as `geodesic_patches` measures directions."""
    out = np.zeros((len(neighbours), 2))
    for v in range(len(first) - 1):
        total, is_open = 0.0, False
        for k in range(first[v + 1] - 1, first[v] - 1, -1):  # the one-ring is clockwise
            out[k, 0] = total
            if left[k] >= 0:
                total += _corner(vertices, v, neighbours[k], left[k])
            else:
                is_open = True
            out[k, 1] = total
        if total > 2 * np.pi or (total > 0 and not is_open):
            out[first[v] : first[v + 1]] *= 2 * np.pi / total
    return out


@njit(cache=True)
def _trace_all(
    vertices, neighbours, first, left, onward, directions, turn, radius, indices, weights
):
    rays = indices.shape[2]
    for v in range(len(first) - 1):
        for ray in range(rays):
            direction = ((ray + 0.5) * 2 * np.pi / rays + turn[v]) % (2 * np.pi)
            for k in range(first[v], first[v + 1]):
                begin, end = directions[k]
                if begin <= direction < end:
                    corner = _corner(vertices, v, neighbours[k], left[k])
                    right = corner * (direction - begin) / (end - begin)
                    _trace(
                        v,
                        k,
                        right,
                        corner - right,
                        vertices,
                        neighbours,
                        left,
                        onward,
                        radius,
                        indices[v, :, ray],
                        weights[v, :, ray],
                    )
                    break


@njit(cache=True)
def _trace(
    v, edge, right_angle, left_angle, vertices, neighbours, left, onward, radius, indices, weights
):
    """Follow one ray and write its samples, [rings, 3].

    The faces that it crosses are laid side by side into the plane, v at the origin and the ray
    along x. It leaves each through an edge from b on its right (y <= 0) to c on its left (y >= 0).
    """
    rings = len(indices)
    b, c = neighbours[edge], left[edge]
    length = _coordinates(vertices, v, b, b)[0]
    bx, by = length * np.cos(right_angle), -length * np.sin(right_angle)
    length = _coordinates(vertices, v, c, c)[0]
    cx, cy = length * np.cos(left_angle), length * np.sin(left_angle)
    out_x, out_t = _crossing(bx, by, cx, cy)
    corners = np.array([v, b, c])  # of the present face
    entry = np.array([1.0, 0.0, 0.0])  # where the ray comes in, by its corners
    leave = np.array([0.0, 1 - out_t, out_t])  # where it goes out
    edge = onward[edge, 0]  # from now on that from c to b
    in_x, ring = 0.0, 0
    for _ in range(MOST_FACES):
        while (ring + 1) / rings * radius <= out_x:
            x = (ring + 1) / rings * radius
            part = (x - in_x) / (out_x - in_x)
            for i in range(3):
                indices[ring, i] = corners[i]
                weights[ring, i] = (1 - part) * entry[i] + part * leave[i]
            ring += 1
            if ring == rings:
                return
        d = left[edge]
        if d < 0:
            return  # left the surface
        ex, ey = cx - bx, cy - by
        length = np.sqrt(ex * ex + ey * ey)
        ex, ey = (ex / length, ey / length) if length > 0 else (0.0, 1.0)
        along, across = _coordinates(vertices, b, c, d)
        dx, dy = bx + along * ex + across * ey, by + along * ey - across * ex
        corners[0], corners[1], corners[2] = b, c, d
        entry[0], entry[1], entry[2] = 1 - out_t, out_t, 0.0
        in_x = out_x
        edge = onward[edge, 0 if dy > 0 else 1]
        if dy > 0:
            c, cx, cy = d, dx, dy
            out_x, out_t = _crossing(bx, by, cx, cy)
            leave[0], leave[1], leave[2] = 1 - out_t, 0.0, out_t
        else:
            b, bx, by = d, dx, dy
            out_x, out_t = _crossing(bx, by, cx, cy)
            leave[0], leave[1], leave[2] = 0.0, out_t, 1 - out_t


@njit(cache=True)
def _corner(vertices, v, b, c):
    """The angle at v between b and c. A right angle where v coincides with one of them: the two
    faces at such an edge then open half a turn to the rays, which go on into the faces around it.
    """
    along, across = _coordinates(vertices, v, b, c)
    if along == 0 and across == 0 and _coordinates(vertices, v, b, b)[0] > 0:
        return np.pi / 2  # v and c coincide
    return np.arctan2(across, along)


@njit(cache=True)
def _coordinates(vertices, b, c, d):
    """Of d - b: the length along c - b, and the length at right angles to it."""
    dot, base, length = 0.0, 0.0, 0.0
    for i in range(3):  # in scalars: arrays of three would cost more than all the rest
        to_c, to_d = vertices[c, i] - vertices[b, i], vertices[d, i] - vertices[b, i]
        dot, base, length = dot + to_c * to_d, base + to_c * to_c, length + to_d * to_d
    along = dot / np.sqrt(base) if base > 0 else 0.0
    return along, np.sqrt(max(length - along * along, 0.0))


@njit(cache=True)
def _crossing(bx, by, cx, cy):
    """Where the edge from b to c meets the x axis: x, and the share of c."""
    t = min(max(by / (by - cy), 0.0), 1.0) if by < cy else 1.0 * (cx > bx)  # or lies along it
    return (1 - t) * bx + t * cx, t
