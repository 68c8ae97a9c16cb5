"""Gaussian windows on geodesic polar patches (Masci, Boscaini, Bronstein, Vandergheynst 2015).

In `geodesic_patches` a cell of the polar grid around a vertex is a point. Here it is a weighted
mean of the vertices around: a Gaussian in distance and in angle, times the areas of the vertices.
The formulae are those of the authors' published code, with its factors 2 for the rings and 0.01 for
the rays. Two things differ: a patch ends at the radius, and distances to the rays are computed from
the polar coordinates.

The polar coordinates are discrete geodesic polar coordinates (Melvaer, Reimers 2012). A front grows
from the vertex as in Dijkstra's algorithm, but across faces: two corners of a face are unfolded
into the plane together with the source of their distances, and the third corner is measured from
there. Where the surface is flat that is exact.
"""

from __future__ import annotations

from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np
from numba import njit

from meshspiral.geometry.connectivity import one_rings
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.patches import check_grid, edge_coordinates, face_sectors, left_corners

LEAST_SHARE = 0.01  # of a row's largest weight; smaller weights are dropped
CLOSER = 1 - 1e-10  # a distance is replaced only by one that is smaller by more than rounding
MOST_TURNS = 100  # times a vertex is processed; needles far longer than 1000 widths reach this


class WindowTable(NamedTuple):
    """The samples of every vertex's grid, as sparse rows of weights.

    For values f of the vertices, sample s = (v * rings + i) * rays + j is the sum over k in
    first[s]:first[s+1] of weights[k] * f[indices[k]]. The rows of an isolated vertex are empty.

    Attributes:
        indices: int32 [E], vertices.
        weights: float32 [E], non-negative, with sum 1 in every row.
        first: int64 [V * rings * rays + 1], the start of every row.
    """

    indices: np.ndarray
    weights: np.ndarray
    first: np.ndarray


def gaussian_windows(
    mesh: Mesh,
    radius: float,
    rings: int = 5,
    rays: int = 16,
    turn: np.ndarray | None = None,
    width: float = 2.0,
) -> WindowTable:
    """The Gaussian windows of all vertices, each over the vertices within a geodesic radius.

    In cell (i, j), counted from 0, vertex u at distance r and angle t has the weight

        area(u) * ring_i(u) * ray_j(u),
        ring_0 = 1 / (1 + exp((r - m_0) / (2 m_0))),   m_i = (i + 1/2) * radius / rings,
        ring_i = exp(-((r - m_i) / (width radius / rings))^2) for i > 0,
        ray_j = exp(-(d / r)^2 / 0.01).

    Here d is the distance to the ray at t_j = (j + 1/2) 2 pi / rays: r |sin(t - t_j)|, or r if
    t - t_j is more than a right angle. Directions are those of `geodesic_patches`. area(u) is a
    third of the area of u's faces; in a patch without area all vertices count alike. The ring_i of
    a vertex are divided by their sum, and so are its ray_j, which are all equal at r = 0. Weights
    below 1 % of the largest of their row are dropped, and the rest is divided by its sum.

    Renumbering the mesh renumbers rows and indices, except for the order within a row and the
    arbitrary first direction. Between two equally short paths the choice is arbitrary.

    Args:
        mesh: The surface.
        radius: Geodesic distance up to which vertices count, in the mesh's unit.
        rings: Number of rings.
        rays: Number of rays.
        turn: float [V], radians by which the grid of each vertex is turned counter-clockwise. None
            for no turn.
        width: Of the rings; the authors' published code has 2 in one copy, 0.2 in another.

    Returns:
        The table of V * rings * rays samples.

    Raises:
        ValueError: `radius` is not positive and finite, or `rings` or `rays` is below 1.
    """
    check_grid(radius, rings, rays)
    neighbours, first = one_rings(mesh)
    surface = mesh.vertices, neighbours, first, left_corners(mesh.faces, neighbours, first)
    sectors = face_sectors(*surface)
    if turn is not None:
        sectors -= np.repeat(turn, np.diff(first))[:, None]
    return WindowTable(
        *_all_windows(
            *surface, sectors, mesh.vertex_areas, float(radius), rings, rays, float(width)
        )
    )


@njit(cache=True)
def _all_windows(vertices, neighbours, first, left, sectors, areas, radius, rings, rays, width):
    """The windows of all vertices.

    Weights are logarithms until a row is written: far from every vertex they would all be 0.

    Args:
        vertices, neighbours, first, left, sectors: As in `face_sectors`.
        areas: float64 [V], a third of the area of the faces of each vertex.
        radius, rings, rays, width: As in `gaussian_windows`.

    Returns:
        The arrays of a `WindowTable`.
    """
    count = len(first) - 1
    distance, angle = np.full(count, np.inf), np.zeros(count)
    updates, disk = np.zeros(count, np.int32), np.empty(count, np.int32)
    log_area, log_ring, log_ray = np.empty(count), np.empty((count, rings)), np.empty((count, rays))
    indices, weights = np.empty(0, np.int32), np.empty(0, np.float32)
    row_first = np.zeros(count * rings * rays + 1, np.int64)
    row, end = 0, 0
    for v in range(count):
        size = polar_coordinates(
            v, vertices, neighbours, first, left, sectors, radius, distance, angle, updates, disk
        )
        most = end + size * rings * rays
        if most > len(indices):
            most += most // 2
            indices, weights = _resized(indices, most, end), _resized(weights, most, end)
        largest = 0.0
        for k in range(size):
            u = disk[k]
            largest = max(largest, areas[u])
            _rings_and_rays(distance[u], angle[u], radius, width, log_ring[k], log_ray[k])
            distance[u] = np.inf
        for k in range(size):
            log_area[k] = np.log(areas[disk[k]]) if largest > 0 else 0.0
        for i in range(rings):
            for j in range(rays):
                end = _write_row(
                    disk[:size], log_area, log_ring[:, i], log_ray[:, j], end, indices, weights
                )
                row += 1
                row_first[row] = end
    return _resized(indices, end, end), _resized(weights, end, end), row_first


@njit(cache=True)
def _resized(old, length, used):
    """An array of `length` elements that begins with the first `used` elements of `old`."""
    new = np.empty(length, old.dtype)
    for k in range(used):
        new[k] = old[k]
    return new


@njit(cache=True)
def _write_row(disk, log_area, log_ring, log_ray, end, indices, weights):
    """Write the row of one cell to `indices` and `weights` from position `end`; return its end."""
    start, total, largest = end, 0.0, -np.inf
    for k in range(len(disk)):
        largest = max(largest, log_area[k] + log_ring[k] + log_ray[k])
    for k in range(len(disk)):
        log_weight = log_area[k] + log_ring[k] + log_ray[k] - largest
        if log_weight >= np.log(LEAST_SHARE):
            indices[end], weights[end] = disk[k], np.exp(log_weight)
            total += np.exp(log_weight)
            end += 1
    for k in range(start, end):
        weights[k] /= total
    return end


@njit(cache=True)
def _rings_and_rays(r, t, radius, width, log_ring, log_ray):
    """Write the logarithms of the normalised ring_i and ray_j of a vertex.

    Args:
        r, t: Its distance and angle.
        radius: Of the patch.
        width: Of the rings.
        log_ring: float64 [rings], written.
        log_ray: float64 [rays], written.
    """
    step = radius / len(log_ring)
    log_ring[0] = -np.logaddexp(0.0, (r - step / 2) / step)
    for i in range(1, len(log_ring)):
        log_ring[i] = -(((r - (i + 0.5) * step) / (width * step)) ** 2)
    for j in range(len(log_ray)):
        offset = wrapped(t - (j + 0.5) * 2 * np.pi / len(log_ray))
        d = np.sin(offset) if abs(offset) < np.pi / 2 else 1.0
        log_ray[j] = -(d**2) / 0.01 if r > 0 else 0.0
    for logs in (log_ring, log_ray):
        total = 0.0  # above 0: some ring is near, and a ray is exp(-100) at least
        for x in logs:
            total += np.exp(x)
        for k in range(len(logs)):
            logs[k] -= np.log(total)


@njit(cache=True)
def wrapped(angle):
    """The same direction as an angle from -pi to pi."""
    return angle - 2 * np.pi * np.round(angle / (2 * np.pi))


@njit(cache=True)
def polar_coordinates(
    v, vertices, neighbours, first, left, sectors, radius, distance, angle, updates, disk
):
    """Write the geodesic polar coordinates around v of all vertices within the radius.

    Behind obtuse corners a distance may decrease again. The vertex is then processed again, but
    later: at once, long rows of needles would correct one another back and forth, in ever smaller
    steps.

    Args:
        v: The centre.
        vertices, neighbours, first, left, sectors: As in `face_sectors`.
        radius: The largest distance.
        distance: float64 [V], all inf; receives distances within the radius.
        angle: float64 [V]; receives angles in radians.
        updates: int32 [V], all 0, and 0 again afterwards. In between: twice the number of times
            that a vertex was processed, plus 1 while it waits in the front.
        disk: int32 [V]; its beginning receives the vertices within the radius.

    Returns:
        The number of vertices within the radius; 0 if v is on no face.
    """
    if first[v] == first[v + 1]:
        return 0
    distance[v], disk[0], count = 0.0, v, 1
    front = [(0.0, v)]
    front.pop()  # an empty list whose element type numba knows
    for k in range(first[v], first[v + 1]):
        u = np.int64(neighbours[k])
        distance[u], angle[u] = edge_coordinates(vertices, v, u, u)[0], sectors[k, 0]
        disk[count], updates[u] = u, 1
        count += 1
        heappush(front, (distance[u], u))
    # the radius plus the longest edge within it: a corner out there may decide on one within
    limit = radius
    while len(front) > 0:
        now, a = heappop(front)
        if updates[a] % 2 == 0:
            continue  # an outdated entry: a has been processed since
        updates[a] += 1
        for k in range(first[a], first[a + 1]):
            x, y, z = a, np.int64(neighbours[k]), np.int64(left[k])
            if distance[a] <= radius:
                limit = max(limit, radius + edge_coordinates(vertices, x, y, y)[0])
            for _ in range(2 if z >= 0 else 0):  # each other corner of the face, from the other two
                r, angle_z = _third_corner(vertices, x, y, z, distance, angle)
                closer = r < CLOSER * distance[z] and (distance[a] <= limit or r <= radius)
                if closer and updates[z] < 2 * MOST_TURNS:
                    if distance[z] == np.inf:
                        disk[count] = z
                        count += 1
                    distance[z], angle[z] = r, angle_z
                    updates[z] |= 1
                    heappush(front, (r if updates[z] == 1 else max(r, 1.2 * now), z))
                x, y, z = z, x, y
    within = 0
    for u in disk[:count]:
        updates[u] = 0
        if distance[u] <= radius:
            disk[within] = u
            within += 1
        else:
            distance[u] = np.inf
    return within


@njit(cache=True)
def _third_corner(vertices, a, b, c, distance, angle):
    """Distance and angle of corner c of the face (a, b, c), from those of a and b.

    In the plane, a is the origin, b lies on the positive x axis, c above it and the source below.
    Where the segment from c to the source does not cross the edge ab, or no such source exists, the
    path leads along an edge, through a or b.
    """
    to_a, to_b = distance[a], distance[b]
    base = edge_coordinates(vertices, a, b, b)[0]
    cx, cy = edge_coordinates(vertices, a, b, c)
    if min(to_a, to_b, base) > 0 and max(to_a, to_b) < np.inf:
        x = (to_a**2 - to_b**2 + base**2) / (2 * base)
        y = np.sqrt(max(to_a**2 - x**2, 0.0))
        if y + cy > 0 and 0 < x + (cx - x) * y / (y + cy) < base:
            cx, cy = cx - x, cy + y
            r = np.sqrt(cx**2 + cy**2)
            if r >= distance[c]:
                return r, 0.0  # will not be used
            # angles at the source, in the plane: from b to a, and from b to c
            wedge = np.arctan2(base * y, y**2 - x * (base - x))
            part = np.arctan2((base - x) * cy - y * cx, (base - x) * cx + y * cy)
            # around v, the angle from b to a is not `wedge`, but within half a turn of it
            apart = wedge + wrapped(angle[a] - angle[b] - wedge)
            return r, angle[b] + apart * part / wedge
    by_a, by_b = to_a + np.sqrt(cx**2 + cy**2), to_b + np.sqrt((cx - base) ** 2 + cy**2)
    return (by_a, angle[a]) if by_a < by_b else (by_b, angle[b])
