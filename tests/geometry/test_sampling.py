"""Sampled spirals visit the places of a polar grid; directions lie where vectors point."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.geometry.barycentric import interpolate
from meshspiral.geometry.connectivity import one_rings
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.sampling import (
    nearest_corners,
    nearest_neighbours,
    places_of_radii,
    sampled_places,
    surface_directions,
)
from meshspiral.geometry.shot import local_frames, shot_descriptors
from tests.meshes import bow_tie, bumpy_sphere, lattice, punctured, two_cones, union


def positions(mesh: Mesh, radius, rings, rays, start) -> np.ndarray:
    """float64 [V, 1 + rings * rays, 3], the points of all places."""
    table = sampled_places(mesh, radius, rings, rays, start)
    return interpolate(mesh.vertices, table.indices, table.weights.astype(float))


def plane(jitter: float = 0.2, size: int = 25) -> Mesh:
    """A flat sheet with unequal triangles, facing +z."""
    mesh = lattice(size, size)
    noise = np.random.default_rng(0).uniform(-jitter, jitter, mesh.vertices.shape)
    return Mesh(mesh.vertices + noise * [1, 1, 0], mesh.faces)


CENTRE = 12 * 25 + 12  # of the sheet


def test_places_in_the_plane_are_the_centre_and_clockwise_rings():
    mesh = plane()
    count = len(mesh.vertices)
    start = surface_directions(mesh, np.tile([1.0, 0, 0], (count, 1)))
    places = positions(mesh, 3.0, 3, 8, start)[CENTRE] - mesh.vertices[CENTRE]
    np.testing.assert_allclose(places[0], 0, atol=1e-12)
    rings = places[1:].reshape(3, 8, 3)
    angles = -np.arange(8) * 2 * np.pi / 8
    for i, ring in enumerate(rings):
        expected = (i + 1) * np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
        np.testing.assert_allclose(ring, expected, atol=1e-5)


@pytest.mark.parametrize("axis", [[1, 0, 0], [-0.3, 2, 0.5], [0.1, -1, 0]])
def test_directions_in_the_plane_are_exact(axis):
    mesh = plane()
    start = surface_directions(mesh, np.tile(np.array(axis, float), (len(mesh.vertices), 1)))
    step = positions(mesh, 1.0, 1, 1, start)[CENTRE, 1] - mesh.vertices[CENTRE]
    np.testing.assert_allclose(step[:2], np.array(axis[:2]) / np.linalg.norm(axis[:2]), atol=1e-5)


def test_directions_are_undefined_along_the_normal_and_without_faces():
    mesh = union(plane(), Mesh([[0, 0, 0]], []))
    axes = np.tile([0.0, 0, 2], (len(mesh.vertices), 1))
    axes[3] = np.nan
    axes[4] = 1, 0, 0
    axes[-1] = 1, 0, 0
    known = np.isfinite(surface_directions(mesh, axes))
    assert known.nonzero()[0].tolist() == [4]
    assert (nearest_neighbours(mesh, axes) >= 0).nonzero()[0].tolist() == [4]


def test_each_place_gives_the_vertex_with_the_largest_weight_of_its_face():
    mesh = bumpy_sphere(1, 3)
    start = np.random.default_rng(0).uniform(0, 6, len(mesh.vertices))
    table = sampled_places(mesh, 0.5, 3, 7, start)
    points = interpolate(mesh.vertices, table.indices, table.weights.astype(float))
    vertices = nearest_corners(table)
    assert (vertices[:, 0] == np.arange(len(mesh.vertices))).all()
    edge = max(
        np.linalg.norm(
            mesh.vertices[mesh.faces[:, i]] - mesh.vertices[mesh.faces[:, i - 1]], axis=1
        ).max()
        for i in range(3)
    )
    assert np.linalg.norm(mesh.vertices[vertices] - points, axis=2).max() < edge * 0.6
    assert (
        vertices == np.take_along_axis(table.indices, table.weights.argmax(2)[..., None], 2)[..., 0]
    ).all()


def test_several_radii_give_the_places_of_each():
    mesh = punctured(bumpy_sphere(1, 3), 0.2)
    start = np.random.default_rng(0).uniform(0, 6, len(mesh.vertices))
    radii = [0.6, 0.2, 0.4]  # some rings of two of them coincide
    for radius, table in zip(radii, places_of_radii(mesh, radii, 3, 5, start), strict=True):
        expected = sampled_places(mesh, radius, 3, 5, start)
        np.testing.assert_array_equal(table.indices, expected.indices)
        np.testing.assert_array_equal(table.weights, expected.weights)
    with pytest.raises(ValueError, match="radius must be positive"):
        places_of_radii(mesh, [0.2, -1.0], 3, 5, start)


def test_a_mesh_coarser_than_the_grid_repeats_vertices():
    mesh = bumpy_sphere(0, 1)
    vertices = nearest_corners(sampled_places(mesh, 0.2, 4, 16, np.zeros(len(mesh.vertices))))
    distinct = np.array([len(set(row)) for row in vertices.tolist()])
    assert (
        vertices.shape == (len(mesh.vertices), 65)
        and (distinct < 12).all()
        and (vertices >= 0).all()
    )


def test_a_ray_ends_where_the_surface_does():
    mesh = plane(0.1)
    start = surface_directions(mesh, np.tile([1.0, 0.1, 0], (len(mesh.vertices), 1)))
    v = 12 * 25 + 22  # two columns from the boundary
    ray = positions(mesh, 8.0, 8, 1, start)[v, 1:]
    inside = np.linalg.norm(ray - mesh.vertices[v], axis=1)
    np.testing.assert_allclose(inside[0], 1.0, atol=1e-5)
    np.testing.assert_allclose(ray[3:], np.broadcast_to(ray[-1], (5, 3)), atol=1e-6)
    assert 1.5 < inside[-1] < 3  # on the boundary


def test_a_ray_that_cannot_start_stays_at_the_vertex():
    mesh = union(lattice(2, 2), Mesh([[0, 0, 0]], []))
    vertices = nearest_corners(sampled_places(mesh, 0.5, 2, 8, np.zeros(5)))
    assert (vertices[4] == 4).all()
    corner = vertices[0, 1:].reshape(2, 8)  # its face covers a sixth of the directions
    assert ((corner == 0).all(axis=0)).sum() >= 6 and (vertices >= 0).all()


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("outside", [1, -1])
def test_a_start_off_the_surface_is_the_nearest_edge_and_its_ray_starts(side, outside):
    mesh = lattice(9, 9)
    rng = np.random.default_rng(0)
    mesh = Mesh(mesh.vertices + rng.uniform(-0.1, 0.1, (81, 3)) * [1, 1, 0], mesh.faces)
    boundary = np.arange(1, 8) + (72 if outside > 0 else 0)
    axes = np.tile([0.8 * side, 0.5 * outside, 0], (81, 1))
    start = np.nan_to_num(surface_directions(mesh, axes))
    first = positions(mesh, 0.6, 1, 8, start)[boundary, 1]
    steps = first - mesh.vertices[boundary]
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 0.6, atol=1e-4)
    assert (steps[:, 0] * side > 0.4).all()


@pytest.mark.parametrize("mesh", [bow_tie(), two_cones(), punctured(bumpy_sphere(), 0.3)])
def test_bow_ties_holes_and_isolated_vertices_give_whole_sequences(mesh):
    axes = local_frames(mesh.vertices, 1.5)[:, 0]
    start = np.nan_to_num(surface_directions(mesh, axes))
    table = sampled_places(mesh, 0.5, 2, 6, start)
    assert table.exists.all() and (nearest_corners(table) < len(mesh.vertices)).all()
    np.testing.assert_allclose(table.weights.sum(axis=2), 1, atol=1e-5)


def test_degenerate_faces_give_whole_sequences():
    mesh = bumpy_sphere()
    vertices = mesh.vertices.copy()
    vertices[mesh.faces[7, 1]] = vertices[mesh.faces[7, 0]]
    flat = Mesh(vertices, mesh.faces)
    start = np.nan_to_num(surface_directions(flat, local_frames(vertices, 1.0)[:, 0]))
    table = sampled_places(flat, 0.5, 2, 6, start)
    assert table.exists.all() and np.isfinite(table.weights).all()


@pytest.mark.parametrize("degrees", [10, 100, 190, 280])
def test_a_neighbour_at_the_same_point_does_not_give_the_direction(degrees):
    mesh = lattice(9, 9)
    centre = 4 * 9 + 4
    vertices = mesh.vertices.copy()
    vertices[centre + 1] = vertices[centre]
    axis = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0])
    axes = np.tile(axis, (len(vertices), 1))
    flat = Mesh(vertices, mesh.faces)
    nearest = nearest_neighbours(flat, axes)[centre]
    neighbours, first = one_rings(flat)
    ring = neighbours[first[centre] : first[centre + 1]]
    cosines = (vertices[ring] - vertices[centre]) @ axis
    cosines /= np.linalg.norm(vertices[ring] - vertices[centre], axis=1) + 1e-300
    assert ring[nearest] != centre + 1 and nearest == cosines.argmax()
    if degrees in (100, 190):  # within the faces that are left
        step = positions(flat, 0.5, 1, 1, surface_directions(flat, axes))[centre, 1]
        np.testing.assert_allclose(step - vertices[centre], 0.5 * axis, atol=1e-5)


def test_renumbering_renumbers_the_places():
    mesh = bumpy_sphere(5)
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    place = np.argsort(order)
    turned = np.roll(mesh.renumbered(order).faces, 1, axis=1)
    other = Mesh(mesh.vertices[order], turned[::-1])

    def points(mesh):
        start = surface_directions(mesh, local_frames(mesh.vertices, 1.0)[:, 0])
        table = sampled_places(mesh, 0.7, 3, 8, start)
        return interpolate(mesh.vertices, table.indices, table.weights.astype(float)), table

    ours, table = points(mesh)
    theirs, their_table = points(other)
    np.testing.assert_allclose(theirs, ours[order], atol=2e-5)
    same = nearest_corners(their_table) == place[nearest_corners(table)[order]]
    assert same.mean() > 0.999  # a place at equal weights may take either vertex


def test_frames_are_those_of_the_descriptors():
    from meshspiral.geometry import shot

    mesh = bumpy_sphere(2, 3)
    frames = local_frames(mesh.vertices, 0.6)
    _, theirs = shot._descriptors_and_frames(mesh.vertices, mesh.vertex_normals, 0.6, 4, False)
    np.testing.assert_array_equal(frames, theirs)
    assert np.isnan(local_frames(np.zeros((3, 3)), 1.0)).all()
    with pytest.raises(ValueError, match="radius must be positive"):
        local_frames(mesh.vertices, 0.0)
    with pytest.raises(ValueError, match="vertices must be"):
        shot_descriptors(np.zeros((3, 2)), np.zeros((3, 2)), 1.0)


def test_the_start_turns_with_the_mesh():
    mesh = bumpy_sphere(4, 3)
    q, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    q *= np.sign(np.linalg.det(q))
    other = Mesh(3.0 * mesh.vertices @ q.T, mesh.faces)
    starts = [
        surface_directions(m, local_frames(m.vertices, 0.9 * scale)[:, 0])
        for m, scale in ((mesh, 1.0), (other, 3.0))
    ]
    apart = np.abs((starts[0] - starts[1] + np.pi) % (2 * np.pi) - np.pi)
    assert (apart < 1e-3).mean() > 0.99  # rounding flips an axis where its sides tie


def test_frames_by_area_hold_where_vertices_are_added():
    """Splitting faces of one side changes the count of vertices, not the surface."""
    mesh = bumpy_sphere(4, 3)
    dense = split_faces(mesh, np.flatnonzero(mesh.vertices[mesh.faces].mean(1)[:, 0] > 0.2))
    count = len(mesh.vertices)

    def agreement(by_area):
        axes = [
            local_frames(m.vertices, 1.2, m.vertex_areas if by_area else None)[:count, 0]
            for m in (mesh, dense)
        ]
        return ((axes[0] * axes[1]).sum(axis=1) > np.cos(np.pi / 8)).mean()

    assert agreement(by_area=True) > 0.9 > agreement(by_area=False) + 0.1


def split_faces(mesh: Mesh, chosen: np.ndarray) -> Mesh:
    """The mesh with a new vertex in the middle of each chosen face."""
    a, b, c = mesh.faces[chosen].T
    new = len(mesh.vertices) + np.arange(len(chosen))
    middles = mesh.vertices[mesh.faces[chosen]].mean(axis=1)
    kept = np.delete(mesh.faces, chosen, axis=0)
    parts = [np.stack(part, axis=1) for part in ((a, b, new), (b, c, new), (c, a, new))]
    return Mesh(np.concatenate([mesh.vertices, middles]), np.concatenate([kept, *parts]))
