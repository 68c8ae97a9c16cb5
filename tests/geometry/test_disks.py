"""Geodesic disks: polar coordinates of a plane, renumbering, thinning."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.geometry.disks import geodesic_disks
from meshspiral.geometry.mesh import Mesh
from tests.meshes import bow_tie, bumpy_sphere, lattice, union


def test_a_plane_has_its_polar_coordinates():
    mesh = lattice(11, 11)
    v = 5 * 11 + 5
    table = geodesic_disks(mesh, 3.1, 1000)
    row = table.indices[v][table.indices[v] >= 0]
    offsets = mesh.vertices[row] - mesh.vertices[v]
    lengths = np.linalg.norm(offsets, axis=1)
    expected = np.flatnonzero(np.linalg.norm(mesh.vertices - mesh.vertices[v], axis=1) <= 3.1)
    assert set(row) == set(expected) and row[0] == v
    np.testing.assert_allclose(table.distances[v, : len(row)], lengths, atol=1e-5)
    assert (np.diff(table.distances[v, : len(row)]) >= 0).all()
    found = table.angles[v, 1 : len(row)]
    directions = np.arctan2(offsets[1:, 1], offsets[1:, 0])
    turns = np.exp(1j * (found - directions))
    np.testing.assert_allclose(turns, turns[0], atol=1e-4)  # one zero direction, one sense


def test_a_turn_is_taken_off_the_angles():
    mesh, turn = bumpy_sphere(), np.random.default_rng(0).uniform(-9, 9, 162)
    plain, turned = (geodesic_disks(mesh, 0.5, 99, each) for each in (None, turn))
    inside = (plain.indices >= 0) & (plain.distances > 0)
    difference = np.exp(1j * (plain.angles - turned.angles - turn[:, None]))[inside]
    np.testing.assert_allclose(difference, 1, atol=1e-5)
    assert (np.abs(turned.angles) <= np.pi + 1e-6).all()


def test_renumbering_a_mesh_renumbers_its_disks():
    mesh, order = bumpy_sphere(), np.random.default_rng(1).permutation(162)
    ours, theirs = geodesic_disks(mesh, 0.5, 99), geodesic_disks(mesh.renumbered(order), 0.5, 99)
    for new, old in enumerate(order):
        one = dict(zip(ours.indices[old], ours.distances[old], strict=True))
        two = dict(zip(theirs.indices[new], theirs.distances[new], strict=True))
        one.pop(-1, None), two.pop(-1, None)
        assert one == pytest.approx({order[u]: r for u, r in two.items()}, abs=1e-6)


def test_large_disks_keep_the_centre_the_last_and_others_evenly():
    mesh = lattice(15, 15)
    whole, some = geodesic_disks(mesh, 5.0, 1000), geodesic_disks(mesh, 5.0, 12)
    v = 7 * 15 + 7
    row = whole.indices[v][whole.indices[v] >= 0]
    assert some.indices.shape == (225, 12) and some.indices[v, 0] == v
    assert some.indices[v, -1] == row[-1]
    positions = [list(row).index(u) for u in some.indices[v]]
    gaps = np.diff(positions)
    assert gaps.max() - gaps.min() <= 1


def test_isolated_vertices_are_alone_and_pieces_apart():
    sphere = bumpy_sphere()
    mesh = union(sphere, Mesh(sphere.vertices + 0.1, sphere.faces))
    mesh = Mesh(np.concatenate([mesh.vertices, [[0.0, 0, 0]]]), mesh.faces)
    table = geodesic_disks(mesh, 0.5, 99)
    assert list(table.indices[-1, :2]) == [324, -1]
    assert table.indices[:162].max() < 162
    assert (geodesic_disks(bow_tie(), 9.0, 9).indices >= 0).all(1).any()


@pytest.mark.parametrize(
    "radius, max_vertices, word", [(0, 5, "radius"), (np.inf, 5, "radius"), (1, 0, "max_vertices")]
)
def test_wrong_arguments_are_refused(radius, max_vertices, word):
    with pytest.raises(ValueError, match=word):
        geodesic_disks(bumpy_sphere(), radius, max_vertices)
