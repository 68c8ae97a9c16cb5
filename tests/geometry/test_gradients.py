"""Gradients at vertices: exact on planes, and turned with the surface."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.geometry.gradients import Gradients, tangent_axes, vertex_gradients
from meshspiral.geometry.mesh import Mesh
from tests.meshes import bow_tie, bumpy_sphere, icosphere, lattice


def gradient(mesh: Mesh, values: np.ndarray) -> np.ndarray:
    """The gradients in space, float [V, 3]."""
    found = vertex_gradients(mesh)
    terms = found.weights * values[found.indices][:, None]
    sums = np.add.reduceat(terms, found.first[:-1], axis=0)
    return np.einsum("vi,vij->vj", sums, found.axes)


def rotation(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def test_linear_functions_on_a_plane_have_their_gradient_up_to_the_boundary():
    plane, turn = lattice(6, 7), rotation(0)
    mesh = Mesh(plane.vertices @ turn.T, plane.faces)
    slope = turn @ [0.3, -1.2, 0.0]
    found = gradient(mesh, mesh.vertices @ slope + 5)
    np.testing.assert_allclose(found, np.tile(slope, (len(mesh.vertices), 1)), atol=1e-9)


def test_a_constant_has_none():
    mesh = bumpy_sphere()
    np.testing.assert_allclose(gradient(mesh, np.full(162, 3.0)), 0, atol=1e-9)


def test_the_height_on_a_sphere_has_the_gradient_of_its_closed_form():
    mesh = icosphere(4)
    normals = mesh.vertices
    expected = np.array([0, 0, 1.0]) - normals[:, 2:] * normals
    np.testing.assert_allclose(gradient(mesh, mesh.vertices[:, 2]), expected, atol=0.02)


def test_it_turns_with_the_mesh_and_is_renumbered_with_it():
    mesh, values = bumpy_sphere(), np.random.default_rng(0).normal(size=162)
    turn, order = rotation(1), np.random.default_rng(2).permutation(162)
    other = Mesh(mesh.vertices @ turn.T, mesh.faces).renumbered(order)
    expected = gradient(mesh, values)[order] @ turn.T
    np.testing.assert_allclose(gradient(other, values[order]), expected, atol=1e-9)


def test_the_axes_are_right_handed_with_the_normal():
    normals = bumpy_sphere().vertex_normals
    axes = tangent_axes(normals)
    np.testing.assert_allclose(np.cross(axes[:, 0], axes[:, 1]), normals, atol=1e-12)


def test_bow_ties_isolated_vertices_and_lines_have_finite_gradients():
    flat = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 5, 5]]), np.array([[0, 1, 2]]))
    for mesh in (bow_tie(), flat):
        assert np.isfinite(vertex_gradients(mesh).weights).all()
    assert (gradient(flat, np.arange(4.0)) == 0).all()  # no normal


def test_rows_begin_with_the_vertex_itself():
    found = vertex_gradients(bumpy_sphere())
    assert isinstance(found, Gradients)
    np.testing.assert_array_equal(found.indices[found.first[:-1]], np.arange(162))
    assert found.first[-1] == len(found.indices) == pytest.approx(162 + 2 * 480)
