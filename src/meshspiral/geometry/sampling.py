"""Spirals over the places of a geodesic polar grid, and the directions where spirals start.

A spiral of vertices (see `meshspiral.geometry.spirals`) visits every vertex of a neighbourhood, so
its reach and shape follow the tessellation. A sampled spiral visits places instead: the points of a
polar grid on the surface (see `meshspiral.geometry.patches`), the centre first, then ring by ring,
clockwise. Each place stands for the vertex of its face with the largest barycentric coordinate.
Vertices are chosen, not blended: it is sub-sampled, not resampled.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from meshspiral.geometry.connectivity import one_rings
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.patches import (
    PatchTable,
    check_grid,
    face_sectors,
    left_corners,
    patches_at,
)

LEAST_TANGENT = 1e-3  # of a unit axis: with less, its direction on the surface means nothing


def sampled_places(
    mesh: Mesh, radius: float, rings: int, rays: int, start: np.ndarray
) -> PatchTable:
    """The places of every vertex's sampled spiral, in order.

    Place 0 is the vertex itself. Place 1 + i * rays + j lies at distance (i + 1) / rings * radius
    in direction start - j 2 pi / rays, so each ring runs clockwise as seen from outside. A ray that
    leaves the surface ends there: its remaining places are the point where it leaves. The places of
    a ray that cannot start, as outside the faces of a boundary vertex, are the vertex itself.

    Args:
        mesh: The surface.
        radius: Distance of the outermost ring, in the mesh's unit.
        rings: Number of rings.
        rays: Number of places of a ring.
        start: float [V], direction of the first place of every ring, in radians, as directions of
            `geodesic_patches`.

    Returns:
        The vertices and weights of all places, [V, 1 + rings * rays, 3].

    Raises:
        ValueError: `radius` is not positive and finite, or `rings` or `rays` is below 1.
    """
    return places_of_radii(mesh, [radius], rings, rays, start)[0]


def places_of_radii(
    mesh: Mesh, radii: Sequence[float], rings: int, rays: int, start: np.ndarray
) -> list[PatchTable]:
    """`sampled_places` of several radii, whose rays are traced once.

    Args:
        mesh: The surface.
        radii: Distances of the outermost rings, in the mesh's unit.
        rings, rays, start: As in `sampled_places`.

    Returns:
        The places of each radius.

    Raises:
        ValueError: A radius is not positive and finite, or `rings` or `rays` is below 1.
    """
    for radius in radii:
        check_grid(radius, rings, rays)
    wanted = np.multiply.outer(radii, (np.arange(rings) + 1) / rings)
    distances, ring_of = np.unique(wanted, return_inverse=True)
    turn = start - np.pi / rays  # ray 0 of a patch lies half a step behind its turn
    traced = patches_at(mesh, distances, rays, turn, clamp=True)
    count = len(mesh.vertices)
    clockwise = -np.arange(rays) % rays
    own = np.repeat(np.arange(count, dtype=np.int32)[:, None, None], 3, axis=2)
    centre = np.zeros((count, 1, 3), np.float32)
    centre[..., 0] = 1.0
    tables = []
    for chosen in ring_of.reshape(wanted.shape):
        places = (array[:, chosen][:, :, clockwise].reshape(count, -1, 3) for array in traced)
        both = zip((own, centre), places, strict=True)
        tables.append(PatchTable(*(np.concatenate(parts, axis=1) for parts in both)))
    return tables


def nearest_corners(places: PatchTable) -> np.ndarray:
    """The vertex with the largest weight of every place.

    Two places share a vertex where the mesh is coarser than the grid; the vertex is then repeated.

    Args:
        places: [V, L, 3], from `sampled_places`.

    Returns:
        int32 [V, L].
    """
    largest = places.weights.argmax(axis=2)[..., None]
    return np.take_along_axis(places.indices, largest, axis=2)[..., 0]


def surface_directions(mesh: Mesh, axes: np.ndarray) -> np.ndarray:
    """The direction of a vector at each vertex, projected onto the tangent plane.

    Args:
        mesh: The surface.
        axes: float [V, 3], for instance the x axes of `meshspiral.geometry.shot.local_frames`.

    Returns:
        float64 [V], radians in the directions of `geodesic_patches`; NaN where the vector is not
        finite or along the normal, and at a vertex on no face. A vector that points beside the
        faces of a boundary vertex gets the direction of the nearest edge.
    """
    neighbours, first = one_rings(mesh)
    left = left_corners(mesh.faces, neighbours, first)
    sectors = face_sectors(mesh.vertices, neighbours, first, left)
    directions = np.full(len(mesh.vertices), np.nan)
    normals, axes = mesh.vertex_normals, np.asarray(axes, dtype=np.float64)
    _directions(mesh.vertices, neighbours, first, left, sectors, normals, axes, directions)
    return directions


def nearest_neighbours(mesh: Mesh, axes: np.ndarray) -> np.ndarray:
    """The neighbour of each vertex that is nearest in direction to a vector at the vertex.

    Args:
        mesh: The surface.
        axes: float [V, 3].

    Returns:
        int64 [V], its position in the one-ring of `one_rings`; -1 where `surface_directions` is
        NaN.
    """
    neighbours, first = one_rings(mesh)
    nearest = np.full(len(mesh.vertices), -1)
    normals, axes = mesh.vertex_normals, np.asarray(axes, dtype=np.float64)
    _nearest(mesh.vertices, neighbours, first, normals, axes, nearest)
    return nearest


@njit(cache=True, error_model="numpy")
def _tangent(normal, axis, tangent, bitangent):
    """Write the unit tangent along an axis, and normal x tangent; False if there is none."""
    dot = normal[0] * axis[0] + normal[1] * axis[1] + normal[2] * axis[2]
    square = 0.0
    for i in range(3):
        tangent[i] = axis[i] - dot * normal[i]
        square += tangent[i] * tangent[i]
    if not square > LEAST_TANGENT**2:  # also NaN
        return False
    for i in range(3):
        tangent[i] /= np.sqrt(square)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        bitangent[i] = normal[j] * tangent[k] - normal[k] * tangent[j]
    return True


@njit(cache=True, error_model="numpy")
def _edge_angle(vertices, v, w, tangent, bitangent):
    """The angle of the edge from v to w in the tangent plane, counter-clockwise, in -pi..pi.

    NaN, which compares as neither below nor above, if v and w coincide there.
    """
    x, y = 0.0, 0.0
    for i in range(3):
        step = vertices[w, i] - vertices[v, i]
        x += step * tangent[i]
        y += step * bitangent[i]
    return np.arctan2(y, x) if x != 0 or y != 0 else np.nan


@njit(cache=True, error_model="numpy")
def _directions(vertices, neighbours, first, left, sectors, normals, axes, directions):
    """Write the directions of `surface_directions`.

    The tangent lies at angle 0 of the tangent plane, inside a face whose edges have one angle below
    and one above. If several faces do, as at a fold, the one whose lower edge is nearest counts.
    """
    tangent, bitangent = np.empty(3), np.empty(3)
    for v in range(len(first) - 1):
        if not _tangent(normals[v], axes[v], tangent, bitangent):
            continue
        inside, beside = np.inf, np.inf
        for k in range(first[v], first[v + 1]):
            angle = _edge_angle(vertices, v, neighbours[k], tangent, bitangent)
            if abs(angle) < beside and inside == np.inf:
                # of the last edge before a boundary: just inside the last face
                beside = abs(angle)
                directions[v] = sectors[k, 0] * (1 - 1e-9 if left[k] < 0 else 1)
            if left[k] < 0:
                continue
            below = -angle % (2 * np.pi)
            other = _edge_angle(vertices, v, left[k], tangent, bitangent)
            width = (other - angle) % (2 * np.pi)
            if below < width and below < inside:
                inside = below
                begin, end = sectors[k]
                directions[v] = begin + (end - begin) * below / width


@njit(cache=True, error_model="numpy")
def _nearest(vertices, neighbours, first, normals, axes, nearest):
    """Write the neighbours of `nearest_neighbours`."""
    tangent, bitangent = np.empty(3), np.empty(3)
    for v in range(len(first) - 1):
        if not _tangent(normals[v], axes[v], tangent, bitangent):
            continue
        smallest = np.inf
        for k in range(first[v], first[v + 1]):
            angle = abs(_edge_angle(vertices, v, neighbours[k], tangent, bitangent))
            if angle < smallest:
                smallest, nearest[v] = angle, k - first[v]
