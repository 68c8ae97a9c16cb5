"""Mending: what comes out is a mesh, and every vertex of the user is accounted for."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.geometry.mesh import Mesh, MeshError
from meshspiral.geometry.repair import repair
from tests.damage import damaged
from tests.meshes import bumpy_sphere, lattice, punctured, torus

SPHERE = bumpy_sphere()


@pytest.mark.parametrize("mesh", [SPHERE, lattice(4, 5), torus()])
def test_a_sound_mesh_stays_as_it_is(mesh):
    found = repair(mesh.vertices, mesh.faces, "a")
    np.testing.assert_array_equal(found.place, np.arange(len(mesh.vertices)))
    np.testing.assert_array_equal(found.mesh.faces, mesh.faces)
    assert found.changes == []


def test_small_holes_are_closed_and_large_ones_stay():
    sphere = bumpy_sphere(subdivisions=4)
    sealed = repair(sphere.vertices, sphere.faces[[*range(9), *range(10, 5120)]], "a")
    assert sealed.changes == ["1 faces put into holes"]
    assert sealed.mesh.area == pytest.approx(sphere.area, rel=1e-9)
    torn = punctured(sphere, 0.02)
    found = repair(torn.vertices, torn.faces, "a")
    assert found.mesh.area == pytest.approx(sphere.area, rel=2e-3)
    half = sphere.faces[(sphere.vertices[sphere.faces][:, :, 2] > 0).all(axis=1)]
    assert repair(sphere.vertices, half, "a").changes == []


@pytest.mark.parametrize("seed", range(100))
def test_a_vertex_keeps_its_place_or_is_left_out(seed):
    vertices, faces = damaged(SPHERE, seed)
    try:
        found = repair(vertices, faces, "a")
    except MeshError as error:
        assert "no face that can be used" in str(error)
        return
    there = found.place >= 0
    np.testing.assert_array_equal(found.mesh.vertices[found.place[there]], vertices[there])
    valid = ((faces >= 0) & (faces < len(vertices))).all(axis=1)
    named = np.unique(faces[valid])
    lost = np.setdiff1d(named, np.flatnonzero(there))
    assert len(found.changes) or len(lost) == 0  # nothing goes without a word


def test_vertices_at_one_place_become_one():
    torn = SPHERE.vertices[SPHERE.faces.ravel()]
    found = repair(torn, np.arange(len(torn)).reshape(-1, 3), "a")
    assert len(found.mesh.vertices) == len(SPHERE.vertices)
    assert found.changes == [
        f"{len(torn) - len(SPHERE.vertices):,} vertices joined with others at their place"
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


def test_turned_faces_turn_back():
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
    assert found.changes[-1] == "1 edges cut open where the faces can't agree"
    assert len(found.mesh.faces) == 2 * n


def test_arrays_of_another_shape_are_refused():
    with pytest.raises(MeshError, match=r"vertices must have three columns, got \(162, 2\)"):
        repair(SPHERE.vertices[:, :2], SPHERE.faces, "a")
    with pytest.raises(MeshError, match=r"faces must have three columns, got \(320, 2\)"):
        repair(SPHERE.vertices, SPHERE.faces[:, :2], "a")


def test_a_mesh_without_a_usable_face_is_refused():
    with pytest.raises(MeshError, match="a: no face that can be used"):
        repair(np.full((3, 3), np.nan), np.array([[0, 1, 2]]), "a")
