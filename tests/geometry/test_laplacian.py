"""The Laplacian: closed forms on sphere and plane, small and broken surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.geometry import laplacian as module
from meshspiral.geometry.laplacian import laplacian, spectrum
from meshspiral.geometry.mesh import Mesh, MeshError
from tests.meshes import bumpy_sphere, icosphere, lattice, union


def test_a_sphere_has_the_eigenvalues_l_times_l_plus_1():
    values = spectrum(icosphere(3), 16).values
    expected = np.repeat([0.0, 2.0, 6.0, 12.0], [1, 3, 5, 7])
    np.testing.assert_allclose(values, expected, rtol=0.02, atol=1e-6)


def test_rows_sum_to_0_and_a_linear_function_has_no_energy_inside_a_plane():
    mesh = lattice(7, 6)
    stiffness, masses = laplacian(mesh)
    np.testing.assert_allclose(stiffness.sum(axis=1), 0, atol=1e-12)
    assert masses.sum() == pytest.approx(mesh.area)
    x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
    assert x @ (stiffness @ x) == pytest.approx(mesh.area)  # |grad x|^2 = 1
    assert x @ (stiffness @ y) == pytest.approx(0, abs=1e-12)


def test_both_ways_of_computing_agree(monkeypatch):
    mesh = bumpy_sphere(subdivisions=3)
    sparse = spectrum(mesh, 20)
    monkeypatch.setattr(module, "SMALL", 1000)
    dense = spectrum(mesh, 20)
    np.testing.assert_allclose(sparse.values, dense.values, atol=1e-7)
    overlap = np.abs((sparse.functions.T * sparse.masses) @ dense.functions)
    np.testing.assert_allclose(np.diag(overlap), 1, atol=1e-5)


@pytest.mark.parametrize("subdivisions", [2, 3])
def test_functions_are_orthonormal_and_ascending(subdivisions):
    values, functions, masses = spectrum(bumpy_sphere(subdivisions=subdivisions), 30)
    np.testing.assert_allclose((functions.T * masses) @ functions, np.eye(30), atol=1e-8)
    assert (np.diff(values) >= 0).all() and values[0] == pytest.approx(0, abs=1e-6)


def test_a_mesh_of_fewer_vertices_has_as_many_functions_as_vertices():
    found = spectrum(icosphere(1), 100)
    assert found.values.shape == (42,) and found.functions.shape == (42, 42)


def test_each_piece_has_a_constant_function():
    two = union(bumpy_sphere(0), bumpy_sphere(1, subdivisions=3))
    values = spectrum(two, 6).values
    np.testing.assert_allclose(values[:2], 0, atol=1e-6)
    assert values[2] > 0.1


def test_isolated_vertices_and_flat_faces_are_borne():
    sphere = bumpy_sphere(subdivisions=3)
    vertices = np.concatenate([sphere.vertices, [[9.0, 9, 9]]])
    vertices[sphere.faces[0, 1]] = vertices[sphere.faces[0, 0]]  # faces of area 0 around an edge
    found = spectrum(Mesh(vertices, sphere.faces), 10)
    assert np.isfinite(found.functions).all() and np.isfinite(found.values).all()


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_the_spectrum_does_not_depend_on_the_unit(unit):
    sphere = bumpy_sphere(subdivisions=2)
    vertices = sphere.vertices.copy()
    a, b, c = sphere.faces[0]
    vertices[b] = (vertices[a] + vertices[c]) / 2  # collinear, by rounding not quite
    values = spectrum(Mesh(vertices, sphere.faces), 10).values
    found = spectrum(Mesh(unit * vertices, sphere.faces), 10).values
    np.testing.assert_allclose(found * unit**2, values, rtol=1e-5, atol=1e-6)
    assert values[1] > 0.1


@pytest.mark.parametrize("subdivisions", [2, 3])
def test_isolated_vertices_change_nothing(subdivisions):
    sphere = bumpy_sphere(subdivisions=subdivisions)
    more = Mesh(np.concatenate([[[9.0, 9, 9]] * 3, sphere.vertices]), sphere.faces + 3)
    found, expected = spectrum(more, 10), spectrum(sphere, 10)
    np.testing.assert_allclose(found.values, expected.values, atol=1e-9)
    np.testing.assert_allclose(np.abs(found.functions[3:]), np.abs(expected.functions), atol=1e-6)
    assert not found.functions[:3].any()


def test_a_surface_without_area_is_refused():
    line = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]]), "line")
    with pytest.raises(MeshError, match="line: surface area must be above 0"):
        spectrum(line, 2)
