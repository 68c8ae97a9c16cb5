"""Repair: the result is a mesh, and every vertex of the input is accounted for."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.geometry.mesh import Mesh, MeshError
from meshspiral.geometry.repair import outwards, repair
from tests.damage import damaged
from tests.meshes import bumpy_sphere, lattice, punctured, torus

SPHERE = bumpy_sphere()


@pytest.mark.parametrize("mesh", [SPHERE, lattice(4, 5), torus()])
def test_a_sound_mesh_is_unchanged(mesh):
    found = repair(mesh.vertices, mesh.faces, "a")
    np.testing.assert_array_equal(found.place, np.arange(len(mesh.vertices)))
    np.testing.assert_array_equal(found.mesh.faces, mesh.faces)
    assert found.changes == []


def test_small_holes_are_closed_and_large_ones_are_not():
    sphere = bumpy_sphere(subdivisions=4)
    sealed = repair(sphere.vertices, sphere.faces[[*range(9), *range(10, 5120)]], "a")
    assert sealed.changes == ["1 faces added to close holes"]
    assert sealed.mesh.area == pytest.approx(sphere.area, rel=1e-9)
    torn = punctured(sphere, 0.02)
    found = repair(torn.vertices, torn.faces, "a")
    assert found.mesh.area == pytest.approx(sphere.area, rel=2e-3)
    half = sphere.faces[(sphere.vertices[sphere.faces][:, :, 2] > 0).all(axis=1)]
    assert repair(sphere.vertices, half, "a").changes == []


@pytest.mark.parametrize("seed", range(100))
def test_a_vertex_keeps_its_coordinates_or_is_removed(seed):
    vertices, faces = damaged(SPHERE, seed)
    try:
        found = repair(vertices, faces, "a")
    except MeshError as error:
        assert str(error) == "a: no usable face"
        return
    known = found.place >= 0
    np.testing.assert_array_equal(found.mesh.vertices[found.place[known]], vertices[known])
    np.testing.assert_array_equal(vertices[found.origin], found.mesh.vertices)
    valid = ((faces >= 0) & (faces < len(vertices))).all(axis=1)
    named = np.unique(faces[valid])
    lost = np.setdiff1d(named, np.flatnonzero(known))
    assert len(found.changes) or len(lost) == 0  # no vertex is removed silently


def test_vertices_at_equal_coordinates_are_joined():
    torn = SPHERE.vertices[SPHERE.faces.ravel()]
    found = repair(torn, np.arange(len(torn)).reshape(-1, 3), "a")
    assert len(found.mesh.vertices) == len(SPHERE.vertices)
    assert found.changes == [
        f"{len(torn) - len(SPHERE.vertices):,} vertices joined with others at one point"
    ]
    np.testing.assert_array_equal(found.mesh.vertices[found.place], torn)


def test_the_surface_is_cut_open_along_an_edge_with_three_faces():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]], dtype=float)
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    with pytest.raises(MeshError, match="more than two faces"):
        Mesh(vertices, faces)
    found = repair(vertices, faces, "a")
    assert found.changes == ["1 edges with more than two faces cut open"]
    assert len(found.mesh.faces) == 3 and len(found.mesh.vertices) == 9
    assert sorted(found.place) == sorted(set(found.place))


def test_a_bow_tie_stays_where_no_edge_is_cut():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]], dtype=float)
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    tie = np.array([[0, 0, 0], [1, 0.5, 0], [1, -0.5, 0], [-1.2, -0.5, 0], [-1.2, 0.5, 0.1]])
    both = np.concatenate([vertices, tie + 10]), np.concatenate([faces, [[5, 7, 6], [5, 9, 8]]])
    found = repair(*both, "a")
    assert found.changes == ["1 edges with more than two faces cut open"]
    assert len(found.mesh.vertices) == 9 + 5
    assert len(np.unique(found.place)) == 10


def test_turned_faces_are_turned_back():
    faces = SPHERE.faces.copy()
    faces[[3, 17, 40]] = faces[[3, 17, 40], ::-1]
    found = repair(SPHERE.vertices, faces, "a")
    assert found.changes == ["3 faces turned to agree with their neighbours"]
    np.testing.assert_allclose(found.mesh.vertex_normals, SPHERE.vertex_normals, atol=1e-12)


def test_a_moebius_strip_is_cut_open_once():
    n = 12
    angle = 2 * np.pi * np.arange(n) / n
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    lean = np.stack(
        [np.cos(angle) * np.cos(angle / 2), np.sin(angle) * np.cos(angle / 2), np.sin(angle / 2)], 1
    )
    vertices = np.concatenate([ring - 0.3 * lean, ring + 0.3 * lean])
    faces = []
    for i in range(n):
        a, b = i, i + n
        c, d = (i + 1, i + 1 + n) if i < n - 1 else (n, 0)
        faces += [[a, c, b], [c, d, b]]
    found = repair(vertices, np.array(faces), "a")
    assert found.changes[-1] == "1 edges cut open where faces cannot be turned to agree"
    assert len(found.mesh.faces) == 2 * n


def test_arrays_of_wrong_shape_are_refused():
    with pytest.raises(MeshError, match=r"vertices must have three columns, got \(162, 2\)"):
        repair(SPHERE.vertices[:, :2], SPHERE.faces, "a")
    with pytest.raises(MeshError, match=r"faces must have three columns, got \(320, 2\)"):
        repair(SPHERE.vertices, SPHERE.faces[:, :2], "a")


def test_a_mesh_without_a_usable_face_is_refused():
    with pytest.raises(MeshError, match="a: no usable face"):
        repair(np.full((3, 3), np.nan), np.array([[0, 1, 2]]), "a")


def test_pieces_that_are_inside_out_are_turned():
    faces = np.concatenate([SPHERE.faces, SPHERE.faces[:, ::-1] + len(SPHERE.vertices)])
    mesh = Mesh(np.concatenate([SPHERE.vertices, SPHERE.vertices + 9]), faces)
    turned, count = outwards(mesh)
    assert count == 1
    np.testing.assert_allclose(turned.face_normals, np.tile(SPHERE.face_normals, (2, 1)))
    again, count = outwards(turned)
    assert count == 0
    np.testing.assert_array_equal(again.faces, turned.faces)


def test_an_open_piece_is_turned_only_if_its_volume_is_clearly_negative():
    inside_out = Mesh(SPHERE.vertices, SPHERE.faces[9:, ::-1])
    turned, count = outwards(inside_out)
    assert count == 1
    np.testing.assert_array_equal(turned.faces, SPHERE.faces[9:])
    sheet = lattice(5, 6)
    for faces in (sheet.faces, sheet.faces[:, ::-1]):
        assert outwards(Mesh(sheet.vertices, faces))[1] == 0


def test_as_few_faces_as_possible_are_turned():
    """50 flipped faces, among them the one whose winding trimesh follows."""
    mesh = bumpy_sphere()
    faces = mesh.faces.copy()
    faces[:50] = faces[:50, ::-1]
    repaired = repair(mesh.vertices, faces, "mesh")
    assert repaired.changes == ["50 faces turned to agree with their neighbours"]
    assert outwards(repaired.mesh)[1] == 0
