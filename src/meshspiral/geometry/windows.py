"""Gaussian windows on geodesic polar patches (Masci, Boscaini, Bronstein, Vandergheynst 2015).

Here the cells of the polar grid around a vertex are not points, as in `geodesic_patches`, but
weighted means of the vertices around: Gaussians in distance and angle, times the vertices' areas.
The formulae are those of the authors' published code, with its factors 2 for the rings and 0.01 for
the rays; but a patch ends at the radius, and distances to the rays follow from the coordinates.

These are discrete geodesic polar coordinates (Melvaer, Reimers 2012): a front grows from the vertex
as in Dijkstra's algorithm, but across faces. Two corners of a face are laid into the plane together
with the source that their distances belong to, and the third corner is measured from there. Where
the surface is flat that is exact.
"""

from __future__ import annotations

from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np
from numba import njit

from meshspiral.geometry.connectivity import one_rings
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.patches import _coordinates, _directions, _left, check_grid

LEAST_SHARE = 0.01  # of a row's largest weight; what is below is dropped
CLOSER = 1 - 1e-10  # a distance gives way only to one that is less by more than rounding
MOST_TURNS = 100  # that a vertex is taken up; needles far longer than a thousand widths reach it


class WindowTable(NamedTuple):
    """The weighted sums in sparse rows: sample s = (v * rings + i) * rays + j is the sum over k in
    first[s]:first[s+1] of weights[k] * f[indices[k]], for any values f of the vertices.

    indices: int32 [E]. weights: float32 [E], none negative, of sum 1 in each row.
    first: int64 [V * rings * rays + 1]. The rows of a vertex without a face are empty.
    """

    indices: np.ndarray
    weights: np.ndarray
    first: np.ndarray


def gaussian_windows(
    mesh: Mesh, radius: float, rings: int = 5, rays: int = 16, turn: np.ndarray | None = None
) -> WindowTable:
    """The windows of every vertex over the vertices up to geodesic distance `radius`, itself too.

    In cell (i, j), from 0, vertex u at distance r and angle t has the weight

        area(u) * ring_i(u) * ray_j(u),
        ring_0 = 1 / (1 + exp((r - m_0) / (2 m_0))),   m_i = (i + 1/2) * radius / rings,
        ring_i = exp(-((r - m_i) / (2 radius / rings))^2) for i > 0,
        ray_j = exp(-(d / r)^2 / 0.01),

    with d the distance to the ray at t_j = (j + 1/2) 2 pi / rays: r |sin(t - t_j)|, or r if t - t_j
    is more than a right angle. Directions are those of `geodesic_patches`. For each u the rings are
    divided by their sum, and so are the rays, which are all equal at r = 0. area(u) is a third of
    the area of u's faces; in a patch without area all are equal. What is below a hundredth of a
    row's largest weight is dropped, and the row divided by its sum.

    Renumbering the mesh renumbers rows and indices, but for the order within a row and the
    arbitrary first direction; where two shortest ways are equally long, either may be taken.

    radius: in the mesh's unit. turn: float [V], radians by which the grid of each vertex is turned
    counter-clockwise; None for none. Errors: ValueError for a radius that is not positive and
    finite, or rings or rays below 1.
    """
    check_grid(radius, rings, rays)
    neighbours, first = one_rings(mesh)
    for_numba = mesh.vertices, neighbours, first, _left(mesh.faces, neighbours, first)
    thirds = np.repeat(np.linalg.norm(mesh.face_normals, axis=1) / 6, 3)
    areas = np.bincount(mesh.faces.ravel(), thirds, len(mesh.vertices))
    directions = _directions(*for_numba)
    if turn is not None:
        directions -= np.repeat(turn, np.diff(first))[:, None]
    for_numba += directions, areas
    return WindowTable(*_all_windows(*for_numba, float(radius), rings, rays))


@njit(cache=True)
def _all_windows(vertices, neighbours, first, left, directions, areas, radius, rings, rays):
    """The arrays of a `WindowTable`. Weights are logarithms until a row is written: far from every
    vertex they would all be 0."""
    count = len(first) - 1
    distance, angle = np.full(count, np.inf), np.zeros(count)
    turns, disk = np.zeros(count, np.int32), np.empty(count, np.int32)
    area, ring, ray = np.empty(count), np.empty((count, rings)), np.empty((count, rays))
    indices, weights = np.empty(0, np.int32), np.empty(0, np.float32)
    row_first = np.zeros(count * rings * rays + 1, np.int64)
    row, end = 0, 0
    for v in range(count):
        size = _polar(
            v, vertices, neighbours, first, left, directions, radius, distance, angle, turns, disk
        )
        most = end + size * rings * rays
        if most > len(indices):
            most += most // 2
            indices, weights = _longer(indices, most, end), _longer(weights, most, end)
        largest = 0.0
        for k in range(size):
            u = disk[k]
            largest = max(largest, areas[u])
            _rings_and_rays(distance[u], angle[u], radius, ring[k], ray[k])
            distance[u] = np.inf
        for k in range(size):
            area[k] = np.log(areas[disk[k]]) if largest > 0 else 0.0
        for i in range(rings):
            for j in range(rays):
                end = _write_row(disk[:size], area, ring[:, i], ray[:, j], end, indices, weights)
                row += 1
                row_first[row] = end
    return _longer(indices, end, end), _longer(weights, end, end), row_first


@njit(cache=True)
def _longer(old, length, used):
    new = np.empty(length, old.dtype)
    for k in range(used):
        new[k] = old[k]
    return new


@njit(cache=True)
def _write_row(disk, area, ring, ray, end, indices, weights):
    """Write the row of one cell from `end` on; return where it ends."""
    start, total, largest = end, 0.0, -np.inf
    for k in range(len(disk)):
        largest = max(largest, area[k] + ring[k] + ray[k])
    for k in range(len(disk)):
        weight = area[k] + ring[k] + ray[k] - largest
        if weight >= np.log(LEAST_SHARE):
            indices[end], weights[end] = disk[k], np.exp(weight)
            total += np.exp(weight)
            end += 1
    for k in range(start, end):
        weights[k] /= total
    return end


@njit(cache=True)
def _rings_and_rays(r, t, radius, ring, ray):
    """Write the logarithms of ring_i [rings] and ray_j [rays], each divided by their sum."""
    step = radius / len(ring)
    ring[0] = -np.logaddexp(0.0, (r - step / 2) / step)
    for i in range(1, len(ring)):
        ring[i] = -(((r - (i + 0.5) * step) / (2 * step)) ** 2)
    for j in range(len(ray)):
        off = _turn(t - (j + 0.5) * 2 * np.pi / len(ray))
        d = np.sin(off) if abs(off) < np.pi / 2 else 1.0
        ray[j] = -(d**2) / 0.01 if r > 0 else 0.0
    for logs in (ring, ray):
        total = 0.0  # above 0: some ring is near, and a ray is exp(-100) at least
        for x in logs:
            total += np.exp(x)
        for k in range(len(logs)):
            logs[k] -= np.log(total)


@njit(cache=True)
def _turn(angle):
    """The same direction as an angle of at most half a turn, either way."""
    return angle - 2 * np.pi * np.round(angle / (2 * np.pi))


@njit(cache=True)
def _polar(v, vertices, neighbours, first, left, directions, radius, distance, angle, turns, disk):
    """Write `distance` and `angle` around v of the vertices within the radius, and these into
    `disk`; return their number, 0 where v has no face.

    distance: infinite when it comes, and afterwards at all other vertices. turns: 0, before and
    after; twice how often the vertex has been taken up, and one more while it waits for that.

    Behind obtuse corners a distance may fall again. The vertex is then taken up again, but later:
    at once, long rows of needles would correct one another to and fro, in ever smaller steps.
    """
    if first[v] == first[v + 1]:
        return 0
    distance[v], disk[0], count = 0.0, v, 1
    front = [(0.0, v)]
    front.pop()
    for k in range(first[v], first[v + 1]):
        u = np.int64(neighbours[k])
        distance[u], angle[u] = _coordinates(vertices, v, u, u)[0], directions[k, 0]
        disk[count], turns[u] = u, 1
        count += 1
        heappush(front, (distance[u], u))
    limit = radius  # and the longest edge from within: corners out there may decide on one within
    while len(front) > 0:
        now, a = heappop(front)
        if turns[a] % 2 == 0:
            continue  # stood here twice
        turns[a] += 1
        for k in range(first[a], first[a + 1]):
            x, y, z = a, np.int64(neighbours[k]), np.int64(left[k])
            if distance[a] <= radius:
                limit = max(limit, radius + _coordinates(vertices, x, y, y)[0])
            for _ in range(2 if z >= 0 else 0):  # the face's two other corners, each from the rest
                r, angle_z = _third(vertices, x, y, z, distance, angle)
                closer = r < CLOSER * distance[z] and (distance[a] <= limit or r <= radius)
                if closer and turns[z] < 2 * MOST_TURNS:
                    if distance[z] == np.inf:
                        disk[count] = z
                        count += 1
                    distance[z], angle[z] = r, angle_z
                    turns[z] |= 1
                    heappush(front, (r if turns[z] == 1 else max(r, 1.2 * now), z))
                x, y, z = z, x, y
    within = 0
    for u in disk[:count]:
        turns[u] = 0
        if distance[u] <= radius:
            disk[within] = u
            within += 1
        else:
            distance[u] = np.inf
    return within


@njit(cache=True)
def _third(vertices, a, b, c, distance, angle):
    """Distance and angle of corner c of a face (a, b, c), as those of a and b give them.

    In the plane a is the origin, b lies along x, c above and the source below. Where c does not see
    it through the edge ab, or there is no such source, the way leads along an edge, by a or by b.
    """
    to_a, to_b = distance[a], distance[b]
    base = _coordinates(vertices, a, b, b)[0]
    cx, cy = _coordinates(vertices, a, b, c)
    if min(to_a, to_b, base) > 0 and max(to_a, to_b) < np.inf:
        x = (to_a**2 - to_b**2 + base**2) / (2 * base)
        y = np.sqrt(max(to_a**2 - x**2, 0.0))
        if y + cy > 0 and 0 < x + (cx - x) * y / (y + cy) < base:
            cx, cy = cx - x, cy + y
            r = np.sqrt(cx**2 + cy**2)
            if r >= distance[c]:
                return r, 0.0  # will not be used
            wedge = np.arctan2(base * y, y**2 - x * (base - x))  # from b to a, as the source sees
            part = np.arctan2((base - x) * cy - y * cx, (base - x) * cx + y * cy)  # from b to c
            # from b to a around v: not `wedge`, but within half a turn of it
            apart = wedge + _turn(angle[a] - angle[b] - wedge)
            return r, angle[b] + apart * part / wedge
    by_a, by_b = to_a + np.sqrt(cx**2 + cy**2), to_b + np.sqrt((cx - base) ** 2 + cy**2)
    return (by_a, angle[a]) if by_a < by_b else (by_b, angle[b])
