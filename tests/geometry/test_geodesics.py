"""Geodesic distances: closed forms on planes and spheres, components, degenerate meshes."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.geometry.geodesics import GeodesicSolver, diameter
from meshspiral.geometry.mesh import Mesh, MeshError
from tests.meshes import icosphere, lattice, union


def test_geodesic_distances_on_a_sphere_are_great_circles():
    mesh = icosphere()
    row = GeodesicSolver(mesh).row(5)
    exact = np.arccos(np.clip(mesh.vertices @ mesh.vertices[5], -1, 1))
    assert row[5] == 0 and (row >= 0).all()
    assert np.abs(row - exact).mean() < 0.02 * np.pi


def test_the_diameter_of_a_sphere_is_half_a_great_circle():
    assert diameter(icosphere()) == pytest.approx(np.pi, rel=0.02)


def test_distances_between_components_are_infinite():
    mesh = union(icosphere(1), icosphere(1))
    row = GeodesicSolver(mesh).row(0)
    assert np.isfinite(row[:42]).all() and np.isinf(row[42:]).all()


def test_distances_from_a_vertex_without_a_face_are_infinite():
    sphere = icosphere(1)
    for lone in (0, 7, 42):
        vertices = np.insert(sphere.vertices, lone, [9, 9, 9], axis=0)
        mesh = Mesh(vertices, sphere.faces + (sphere.faces >= lone))
        solver = GeodesicSolver(mesh)
        row = solver.row(5)
        assert np.isinf(row[lone]) and np.isfinite(np.delete(row, lone)).all()
        assert solver.row(lone)[lone] == 0 and np.isinf(np.delete(solver.row(lone), lone)).all()
        assert diameter(mesh) == pytest.approx(diameter(sphere), rel=0.01)


def test_a_mesh_without_area_is_rejected():
    with pytest.raises(MeshError, match="no surface area"):
        GeodesicSolver(Mesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], "flat"))


def test_geodesic_distances_on_a_plane_are_straight():
    mesh = lattice(12, 12)
    row = GeodesicSolver(mesh).row(0)
    exact = np.linalg.norm(mesh.vertices - mesh.vertices[0], axis=1)
    assert np.abs(row - exact).mean() < 0.05 * exact.max()
    corners = mesh.vertices[[0, -1]]  # the ends of the long diagonal
    assert diameter(mesh) == pytest.approx(np.linalg.norm(corners[1] - corners[0]), rel=0.05)
