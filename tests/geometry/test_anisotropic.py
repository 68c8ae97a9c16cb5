"""Anisotropic Laplacians and their kernels, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.geometry.anisotropic import anisotropic_kernels, anisotropic_stiffness
from meshspiral.geometry.curvature import curvature_tensors, principal_directions
from meshspiral.geometry.laplacian import laplacian
from meshspiral.geometry.mesh import Mesh
from tests.geometry.test_curvature import cylinder
from tests.meshes import bumpy_sphere, icosphere, lattice


def directions(mesh: Mesh) -> np.ndarray:
    return principal_directions(mesh, curvature_tensors(mesh, 2))


def along_x(mesh: Mesh) -> np.ndarray:
    """For a mesh in the plane z = 0."""
    return np.tile(np.eye(3)[:2], (len(mesh.faces), 1, 1))


def test_without_anisotropy_it_is_the_cotangent_laplacian():
    mesh = bumpy_sphere()
    for angle in (0.0, 1.1):
        found = anisotropic_stiffness(mesh, directions(mesh), angle, 0.0)
        difference = found - laplacian(mesh)[0]
        assert np.abs(difference.toarray()).max() < 1e-8


def test_rows_sum_to_0_and_the_matrix_is_symmetric_and_not_negative():
    mesh = bumpy_sphere()
    found = anisotropic_stiffness(mesh, directions(mesh), 0.4, 100.0).toarray()
    np.testing.assert_allclose(found.sum(axis=1), 0, atol=1e-10)
    np.testing.assert_allclose(found, found.T, atol=1e-12)
    assert np.linalg.eigvalsh(found).min() > -1e-10


def test_a_quarter_turn_swaps_the_axes():
    mesh = bumpy_sphere()
    axes = directions(mesh)
    swapped = np.stack([axes[:, 1], -axes[:, 0]], axis=1)
    turned = anisotropic_stiffness(mesh, axes, np.pi / 2, 9.0).toarray()
    other = anisotropic_stiffness(mesh, swapped, 0.0, 9.0).toarray()
    np.testing.assert_allclose(turned, other, atol=1e-10)
    assert np.abs(turned - anisotropic_stiffness(mesh, axes, 0.0, 9.0).toarray()).max() > 0.1


def test_the_energy_of_a_linear_function_is_the_conductivity_along_its_gradient():
    mesh = lattice(6, 5)
    x, y, _ = mesh.vertices.T
    stiffness = anisotropic_stiffness(mesh, along_x(mesh), 0.0, 3.0)
    assert x @ (stiffness @ x) == pytest.approx(mesh.area)
    assert y @ (stiffness @ y) == pytest.approx(mesh.area / 4)


def test_a_kernel_on_a_plane_is_the_anisotropic_gaussian():
    mesh = lattice(41, 41)
    v, time, anisotropy = 20 * 41 + 20, 6.0, 3.0
    table = anisotropic_kernels(mesh, along_x(mesh), [time], 2, anisotropy, 60)
    for a, (fast, slow) in enumerate([(0, 1), (1, 0)]):
        offsets = mesh.vertices[table.indices[v, 0, a]] - mesh.vertices[v]
        squares = offsets[:, fast] ** 2 + offsets[:, slow] ** 2 * (1 + anisotropy)
        density = np.sqrt(1 + anisotropy) / (4 * np.pi * time)
        expected = density * np.exp(-squares / (4 * time))
        # the whole row sums to 1, since areas inside the lattice are 1
        np.testing.assert_allclose(table.weights[v, 0, a], expected, atol=0.06 * density)


def test_on_a_cylinder_heat_is_fast_along_the_axis():
    mesh = cylinder()
    table = anisotropic_kernels(mesh, directions(mesh), [0.3], 2, 100.0, 12)
    v = 10  # half way up
    spread = np.abs(mesh.vertices[table.indices[v, 0]] - mesh.vertices[v])  # [A, K, 3]
    assert spread[0, :, 2].max() > 1.0 and spread[0, :, :2].max() < 0.7
    assert spread[1, :, 2].max() < 0.7 and spread[1, :, :2].max() > 1.0


def test_a_truncated_basis_converges_to_the_whole():
    mesh = icosphere(3)
    args = (mesh, directions(mesh), [0.05], 1, 3.0, 5)
    exact = anisotropic_kernels(*args)
    errors = []
    for count in (20, 80, 300):
        some = anisotropic_kernels(*args, eigenfunctions=count)
        errors.append(np.abs(some.weights[..., 0] - exact.weights[..., 0]).max())
    assert errors[0] > errors[1] > errors[2] and errors[2] < 0.01 * exact.weights.max()


def test_entries_are_the_largest_of_their_row_in_order():
    mesh = bumpy_sphere()
    args = (mesh, directions(mesh), [0.02, 0.1], 3, 100.0)
    few, all_ = (anisotropic_kernels(*args, k) for k in (4, 1000))
    assert few.indices.shape == (162, 2, 3, 4) and all_.indices.shape == (162, 2, 3, 162)
    np.testing.assert_array_equal(few.weights, all_.weights[..., :4])
    assert (np.diff(all_.weights, axis=3) <= 0).all()


def test_a_face_that_is_hardly_one_changes_no_kernel_far_away():
    sphere = bumpy_sphere()
    vertices = sphere.vertices.copy()
    a, b, c = sphere.faces[0]
    vertices[b] = (vertices[a] + vertices[c]) / 2 + [1e-15, 0, 0]
    mesh = Mesh(vertices, sphere.faces)
    assert np.linalg.norm(mesh.face_normals[0]) < 1e-15
    stiffness = anisotropic_stiffness(mesh, directions(mesh), 0.4, 100.0).toarray()
    values = np.linalg.eigvalsh(stiffness)
    assert abs(values[0]) < 1e-6 and values[1] > 1e-3


def test_isolated_vertices_have_no_kernel_and_flat_faces_are_borne():
    sphere = bumpy_sphere()
    vertices = np.concatenate([sphere.vertices, [[9.0, 9, 9]]])
    vertices[sphere.faces[0, 1]] = vertices[sphere.faces[0, 0]]
    mesh = Mesh(vertices, sphere.faces)
    table = anisotropic_kernels(mesh, directions(mesh), [0.1], 2, 100.0, 5)
    assert np.isfinite(table.weights).all() and not table.weights[-1].any()
