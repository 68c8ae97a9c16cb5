"""Geodesic polar patches (Masci, Boscaini, Bronstein, Vandergheynst 2015).

A patch is a polar grid on the surface around a vertex: equally spaced rings, and rays at equal
angles. The exponential map lays it out: straightest geodesics (Polthier, Schmies 1998) are traced
from the vertex. Each triangle on the way is unfolded into the plane of the one before, where the
geodesic is a straight line. A geodesic that wraps around a finger is no longer the shortest path,
but still straightest.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from meshspiral.geometry.connectivity import one_rings
from meshspiral.geometry.digest import derived_seed
from meshspiral.geometry.mesh import Mesh

MOST_FACES = 10_000  # crossed by one ray; only damaged meshes reach this limit


class PatchTable(NamedTuple):
    """The samples of every vertex's grid, each a weighted sum of the three vertices of a face.

    A sample is missing where its ray has left the surface, and where the vertex has no faces with
    an angle into which the ray could be shot.

    Attributes:
        indices: int32 [V, rings, rays, 3], the vertices; 0 at missing samples.
        weights: float32 [V, rings, rays, 3], barycentric coordinates: non-negative, with sum 1; all
            0 at missing samples.
    """

    indices: np.ndarray
    weights: np.ndarray

    @property
    def exists(self) -> np.ndarray:
        """bool [V, rings, rays]: whether each sample exists."""
        return self.weights.any(axis=-1)


def geodesic_patches(
    mesh: Mesh,
    radius: float,
    rings: int = 5,
    rays: int = 16,
    turn: np.ndarray | None = None,
    clamp: bool = False,
) -> PatchTable:
    """The polar grids of all vertices (Masci et al. 2015).

    Sample (i, j) lies at distance (i + 1) / rings * radius in direction (j + 1/2) 2 pi / rays,
    counter-clockwise as seen from outside. A direction is the sum of the faces' angles at the
    vertex up to it, from an arbitrary neighbour, rescaled so that a full turn is 2 pi. At a
    boundary vertex, angles are rescaled only if they sum to more than 2 pi; they start at the last
    edge clockwise, and directions outside the faces have no samples. At a bow tie, the angles of
    one fan follow those of the other.

    Args:
        mesh: The surface.
        radius: Distance of the outermost ring, in the mesh's unit.
        rings: Number of rings.
        rays: Number of rays.
        turn: float [V], radians by which the grid of each vertex is turned counter-clockwise. None
            for no turn.
        clamp: Give missing samples the last point of their ray: the one where it leaves the
            surface, or the vertex itself if the ray cannot start. Then every sample exists.

    Returns:
        The table of V * rings * rays samples.

    Raises:
        ValueError: `radius` is not positive and finite, or `rings` or `rays` is below 1.
    """
    check_grid(radius, rings, rays)
    turn = np.zeros(len(mesh.vertices)) if turn is None else turn
    return patches_at(mesh, (np.arange(rings) + 1) / rings * radius, rays, turn, clamp)


def patches_at(
    mesh: Mesh, distances: np.ndarray, rays: int, turn: np.ndarray, clamp: bool
) -> PatchTable:
    """The grids of `geodesic_patches` with rings at any distances.

    Args:
        mesh: The surface.
        distances: float [R], ascending, in the mesh's unit.
        rays, turn, clamp: As in `geodesic_patches`.

    Returns:
        The table of V * R * rays samples.
    """
    neighbours, first = one_rings(mesh)
    left = left_corners(mesh.faces, neighbours, first)
    shape = (len(mesh.vertices), len(distances), rays, 3)
    indices, weights = np.zeros(shape, np.int32), np.zeros(shape, np.float32)
    surface = mesh.vertices, neighbours, first, left
    exits, apexes = _exit_edges(neighbours, first, left), _apexes(*surface)
    sectors = face_sectors(*surface)
    distances, turn = (np.asarray(x, dtype=np.float64) for x in (distances, turn))
    _trace_all(*surface, exits, apexes, sectors, turn, distances, clamp, indices, weights)
    table = PatchTable(indices, weights)
    if clamp:
        missing = ~table.exists
        indices[missing] = missing.nonzero()[0][:, None]
        weights[missing] = 1.0, 0.0, 0.0
    return table


def first_directions(mesh: Mesh) -> np.ndarray:
    """Directions in which the grids begin: random, but always the same for one mesh.

    With directions taken from the edges, a network could recognise the vertices of registered
    meshes by them.

    Returns:
        float64 [V], in radians.
    """
    rng = np.random.default_rng(derived_seed(mesh.vertices, mesh.faces))
    return rng.uniform(0, 2 * np.pi, len(mesh.vertices))


def check_radius(radius: float) -> None:
    """Raise ValueError if a radius is not positive and finite."""
    if not (np.isfinite(radius) and radius > 0):
        raise ValueError(f"radius must be positive and finite, got {radius}")


def check_grid(radius: float, rings: int, rays: int) -> None:
    """Check the size of a polar grid.

    Raises:
        ValueError: `radius` is not positive and finite, or `rings` or `rays` is below 1.
    """
    check_radius(radius)
    if rings < 1 or rays < 1:
        raise ValueError(f"rings and rays must be at least 1, got {rings} and {rays}")


@njit(cache=True)
def _edge_index(neighbours, first, a, b):
    """The index in `neighbours` of the directed edge from a to b, -1 if there is none."""
    for k in range(first[a], first[a + 1]):
        if neighbours[k] == b:
            return k
    return -1


@njit(cache=True)
def left_corners(faces, neighbours, first):
    """The third vertex of the face on the left of every directed edge.

    Args:
        faces: int32 [F, 3].
        neighbours, first: As `one_rings` returns them; neighbours has one entry per directed edge.

    Returns:
        int32 [E]; -1 where there is no face.
    """
    left = np.full(len(neighbours), -1, np.int32)
    for face in faces:
        for i in range(3):
            edge = _edge_index(neighbours, first, face[i], face[(i + 1) % 3])
            left[edge] = face[(i + 2) % 3]
    return left


@njit(cache=True)
def _exit_edges(neighbours, first, left):
    """The edges by which a ray leaves the face on the left of every directed edge.

    Args:
        neighbours, first: As `one_rings` returns them.
        left: As `left_corners` returns it.

    Returns:
        int32 [E, 2]: for the directed edge from c to b, with d on its left, the directed edges from
        d to b and from c to d. The next face is on the left of these. -1 where there is no face.
    """
    exits = np.full((len(neighbours), 2), -1, np.int32)
    for c in range(len(first) - 1):
        for k in range(first[c], first[c + 1]):
            d = left[k]
            if d >= 0:
                exits[k, 0] = _edge_index(neighbours, first, d, neighbours[k])
                exits[k, 1] = _edge_index(neighbours, first, c, d)
    return exits


@njit(cache=True)
def _apexes(vertices, neighbours, first, left):
    """The third corner of the face on the left of every directed edge, seen from the edge.

    Args:
        vertices: float64 [V, 3].
        neighbours, first: As `one_rings` returns them.
        left: As `left_corners` returns it.

    Returns:
        float64 [E, 2]: for the directed edge from c to b, with d on its left, d - b is the first
        times c - b, plus a vector orthogonal to it, whose length is the second times that of c - b.
        If b and c coincide, 0 and minus the length of d - b.
    """
    apexes = np.zeros((len(neighbours), 2))
    for c in range(len(first) - 1):
        for k in range(first[c], first[c + 1]):
            if left[k] >= 0:
                along, across = edge_coordinates(vertices, neighbours[k], c, left[k])
                length = edge_coordinates(vertices, neighbours[k], c, c)[0]
                if length > 0:
                    apexes[k, 0], apexes[k, 1] = along / length, across / length
                else:
                    apexes[k, 1] = -across
    return apexes


@njit(cache=True)
def face_sectors(vertices, neighbours, first, left):
    """The interval of directions that the face on the left of every directed edge covers.

    Args:
        vertices: float64 [V, 3].
        neighbours, first: As `one_rings` returns them.
        left: As `left_corners` returns it.

    Returns:
        float64 [E, 2], begin and end in radians, counter-clockwise around the edge's source, in the
        directions of `geodesic_patches`.
    """
    sectors = np.zeros((len(neighbours), 2))
    for v in range(len(first) - 1):
        total, is_open = 0.0, False
        for k in range(first[v + 1] - 1, first[v] - 1, -1):  # the one-ring is clockwise
            sectors[k, 0] = total
            if left[k] >= 0:
                total += _corner_angle(vertices, v, neighbours[k], left[k])
            else:
                is_open = True
            sectors[k, 1] = total
        if total > 2 * np.pi or (total > 0 and not is_open):
            sectors[first[v] : first[v + 1]] *= 2 * np.pi / total
    return sectors


@njit(cache=True)
def _trace_all(
    vertices,
    neighbours,
    first,
    left,
    exits,
    apexes,
    sectors,
    turn,
    distances,
    clamp,
    indices,
    weights,
):
    """Trace the rays of all vertices; write indices and weights, [V, rings, rays, 3]."""
    rays = indices.shape[2]
    for v in range(len(first) - 1):
        for ray in range(rays):
            direction = ((ray + 0.5) * 2 * np.pi / rays + turn[v]) % (2 * np.pi)
            for k in range(first[v], first[v + 1]):
                begin, end = sectors[k]
                if begin <= direction < end:
                    corner = _corner_angle(vertices, v, neighbours[k], left[k])
                    right = corner * (direction - begin) / (end - begin)
                    _trace(
                        v,
                        k,
                        right,
                        corner - right,
                        vertices,
                        neighbours,
                        left,
                        exits,
                        apexes,
                        distances,
                        clamp,
                        indices[v, :, ray],
                        weights[v, :, ray],
                    )
                    break


@njit(cache=True)
def _trace(
    v,
    edge,
    right_angle,
    left_angle,
    vertices,
    neighbours,
    left,
    exits,
    apexes,
    distances,
    clamp,
    indices,
    weights,
):
    """Trace one ray and write its samples, [rings, 3].

    The faces that it crosses are unfolded into the plane, with v at the origin and the ray along
    the x axis. The ray leaves every face through an edge from b on its right (y <= 0) to c on its
    left (y >= 0).

    Args:
        v: The vertex that the ray starts from.
        edge: Index of the directed edge from v whose left face the ray starts in.
        right_angle: Angle at v between that edge and the ray, in radians.
        left_angle: Angle at v between the ray and the face's other edge at v.
        vertices, neighbours, left: The surface.
        exits, apexes: Of every directed edge.
        distances, clamp: As in `patches_at`.
        indices: int32 [rings, 3], written.
        weights: float32 [rings, 3], written.
    """
    rings = len(indices)
    b, c = neighbours[edge], left[edge]
    length = edge_coordinates(vertices, v, b, b)[0]
    bx, by = length * np.cos(right_angle), -length * np.sin(right_angle)
    length = edge_coordinates(vertices, v, c, c)[0]
    cx, cy = length * np.cos(left_angle), length * np.sin(left_angle)
    out_x, out_t = _crossing(bx, by, cx, cy)
    # corners of the current face, and barycentric coordinates where the ray enters and leaves it;
    # in scalars: arrays of three would cost more than all else
    corner0, corner1, corner2 = v, b, c
    enter0, enter1 = 1.0, 0.0  # it never enters through the third corner
    leave0, leave1, leave2 = 0.0, 1 - out_t, out_t
    edge = exits[edge, 0]  # from now on the edge from c to b
    in_x, ring = 0.0, 0
    for _ in range(MOST_FACES):
        while distances[ring] <= out_x:
            part = (distances[ring] - in_x) / (out_x - in_x)
            indices[ring, 0], indices[ring, 1], indices[ring, 2] = corner0, corner1, corner2
            weights[ring, 0] = (1 - part) * enter0 + part * leave0
            weights[ring, 1] = (1 - part) * enter1 + part * leave1
            weights[ring, 2] = part * leave2
            ring += 1
            if ring == rings:
                return
        d = left[edge]
        if d < 0:  # the ray has left the surface
            for rest in range(ring, rings if clamp else ring):
                indices[rest, 0], indices[rest, 1], indices[rest, 2] = corner0, corner1, corner2
                weights[rest, 0], weights[rest, 1], weights[rest, 2] = leave0, leave1, leave2
            return
        along, across = apexes[edge]
        ex, ey = cx - bx, cy - by
        dx, dy = bx + along * ex + across * ey, by + along * ey - across * ex
        if across < 0:  # b and c coincide
            dx, dy = bx - across, by
        corner0, corner1, corner2 = b, c, d
        enter0, enter1, in_x = 1 - out_t, out_t, out_x
        edge = exits[edge, 0 if dy > 0 else 1]
        if dy > 0:
            c, cx, cy = d, dx, dy
            out_x, out_t = _crossing(bx, by, cx, cy)
            leave0, leave1, leave2 = 1 - out_t, 0.0, out_t
        else:
            b, bx, by = d, dx, dy
            out_x, out_t = _crossing(bx, by, cx, cy)
            leave0, leave1, leave2 = 0.0, out_t, 1 - out_t


@njit(cache=True)
def _corner_angle(vertices, v, b, c):
    """The angle at v between b and c, in radians.

    A right angle where v coincides with b or c. The two faces at such an edge then offer half a
    turn to the rays, which continue into the faces around the edge.
    """
    along, across = edge_coordinates(vertices, v, b, c)
    if along == 0 and across == 0 and edge_coordinates(vertices, v, b, b)[0] > 0:
        return np.pi / 2  # v and c coincide
    return np.arctan2(across, along)


@njit(cache=True)
def edge_coordinates(vertices, b, c, d):
    """The coordinates of d in the frame of the edge from b to c.

    Args:
        vertices: float64 [V, 3].
        b, c, d: Indices of vertices. With c = d the first result is the length of the edge.

    Returns:
        The component of d - b along c - b, and the length of the component orthogonal to it. If b
        and c coincide, the first is 0.
    """
    dot, base, length = 0.0, 0.0, 0.0
    for i in range(3):  # in scalars: arrays of three would cost more than everything else
        to_c, to_d = vertices[c, i] - vertices[b, i], vertices[d, i] - vertices[b, i]
        dot, base, length = dot + to_c * to_d, base + to_c * to_c, length + to_d * to_d
    along = dot / np.sqrt(base) if base > 0 else 0.0
    return along, np.sqrt(max(length - along * along, 0.0))


@njit(cache=True)
def _crossing(bx, by, cx, cy):
    """The crossing of the edge from b to c with the x axis: its x, and the weight of c there."""
    t = min(max(by / (by - cy), 0.0), 1.0) if by < cy else 1.0 * (cx > bx)  # or lies along it
    return (1 - t) * bx + t * cx, t
