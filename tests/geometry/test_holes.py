"""Small holes are closed with the vertices that are there; the surface remains a mesh."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.geometry.holes import boundary_loops, close_holes
from meshspiral.geometry.mesh import Mesh
from tests.meshes import bow_tie, bumpy_sphere, lattice, punctured, torus

SPHERE = bumpy_sphere(subdivisions=4)


def without(mesh: Mesh, faces: list[int]) -> Mesh:
    return mesh.with_faces(np.delete(mesh.faces, faces, axis=0))


@pytest.mark.parametrize("mesh", [SPHERE, torus()])
def test_a_closed_mesh_is_unchanged(mesh):
    assert close_holes(mesh) is mesh
    assert boundary_loops(mesh.faces) == []


def test_a_missing_face_is_put_back_with_its_winding():
    closed = close_holes(without(SPHERE, [7]))
    np.testing.assert_array_equal(closed.faces[:-1], np.delete(SPHERE.faces, 7, axis=0))
    face = closed.faces[-1]
    rolled = [np.roll(face, k).tolist() for k in range(3)]
    assert SPHERE.faces[7].tolist() in rolled


def test_a_loop_is_wound_as_the_faces_that_fill_it():
    mesh = lattice(4, 4)
    loops = boundary_loops(mesh.faces)
    assert len(loops) == 1 and len(loops[0]) == 12
    points = mesh.vertices[loops[0]]
    steps = np.roll(points, -1, axis=0) - points
    assert np.cross(points, steps).sum(axis=0)[2] < 0  # a lid on the other side faces down


def test_each_loop_at_a_bow_tie_keeps_to_its_fan():
    loops = boundary_loops(bow_tie().faces)
    assert sorted(sorted(loop.tolist()) for loop in loops) == [[0, 1, 2], [0, 3, 4]]


def test_holes_that_meet_in_a_vertex_are_separate():
    ring = lattice(5, 5)
    at = np.flatnonzero((ring.faces == 12).any(axis=1))  # the six faces around the middle
    loops = boundary_loops(without(ring, [at[0], at[5]]).faces)
    assert sorted(map(len, loops)) == [3, 3, 16]


@pytest.mark.parametrize("seed", range(5))
def test_a_tenth_of_the_faces_missing_is_mended(seed):
    torn = punctured(SPHERE, 0.1, seed)
    closed = close_holes(torn)
    np.testing.assert_array_equal(closed.faces[: len(torn.faces)], torn.faces)
    assert closed.vertices is torn.vertices
    missing = SPHERE.area - torn.area
    assert abs(SPHERE.area - closed.area) < 0.05 * missing


def test_a_hole_longer_than_the_circle_stays_open():
    cap = SPHERE.vertices[SPHERE.faces][:, :, 2].min(axis=1) > 0.9 * SPHERE.vertices[:, 2].max()
    torn = SPHERE.with_faces(SPHERE.faces[~cap])
    (loop,) = boundary_loops(torn.faces)
    points = torn.vertices[loop]
    length = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1).sum()
    radius = length / (2 * np.pi * torn.size)
    assert close_holes(torn, 0.99 * radius) is torn
    closed = close_holes(torn, 1.01 * radius)
    assert len(closed.faces) == len(torn.faces) + len(loop) - 2
    assert boundary_loops(closed.faces) == []


def test_the_radius_relates_to_the_complete_surface():
    torn = without(SPHERE, [7])
    tiny = Mesh(torn.vertices, torn.faces, "a", complete_area=1e-6 * torn.area)
    assert close_holes(tiny) is tiny


def test_the_rim_of_a_sheet_gets_no_lid():
    """A lid on a flat sheet would lie on it, facing the other way."""
    sheet = lattice(3, 3)
    assert close_holes(sheet, radius=10.0) is sheet


def test_a_slit_stays_open():
    """Two faces whose common edge is doubled: the hole between the copies has no area."""
    mesh = lattice(4, 4)
    vertices = np.concatenate([mesh.vertices, mesh.vertices[[5]]])
    faces = mesh.faces.copy()
    upper = (faces == 5).any(axis=1) & (mesh.vertices[faces].mean(axis=1)[:, 1] > np.sqrt(3) / 2)
    faces[upper] = np.where(faces[upper] == 5, len(mesh.vertices), faces[upper])
    slit = Mesh(vertices, faces)
    assert sorted(map(len, boundary_loops(slit.faces))) == [4, 12]
    assert close_holes(slit, radius=1.0) is slit


def test_coordinates_out_of_range_are_left_alone():
    torn = without(SPHERE, [7])
    for scale in (1e200, 1e-200):
        assert len(close_holes(torn.with_faces(torn.faces)).faces) == len(torn.faces) + 1
        far = Mesh(scale * torn.vertices, torn.faces)
        assert close_holes(far) is far
