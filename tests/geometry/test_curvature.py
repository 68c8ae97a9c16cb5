"""Curvature by normal cycles: cylinders and spheres in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.geometry.curvature import (
    curvature_tensors,
    dihedral_angles,
    principal_directions,
)
from meshspiral.geometry.mesh import Mesh
from tests.meshes import bow_tie, bumpy_sphere, icosphere, lattice


def cylinder(around: int = 40, along: int = 20, radius: float = 2.0, height: float = 6.0) -> Mesh:
    """An open cylinder around the z axis, seen from outside."""
    i, j = (x.ravel() for x in np.meshgrid(np.arange(around), np.arange(along), indexing="ij"))
    angle = 2 * np.pi * i / around
    z = height * j / (along - 1)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    a = np.arange(around * along).reshape(around, along)
    right = np.roll(a, -1, axis=0)
    squares = a[:, :-1], right[:, :-1], right[:, 1:], a[:, 1:]
    p, q, r, s = (x.ravel() for x in squares)
    faces = np.concatenate([np.stack([p, q, r], 1), np.stack([p, r, s], 1)])
    return Mesh(points, faces)


def test_a_ridge_has_a_positive_angle_and_a_valley_a_negative_one():
    vertices = np.array([[0.0, 0, 0], [0, 1, 0], [-1, 0.5, -1], [1, 0.5, -1]])
    faces = np.array([[0, 1, 2], [1, 0, 3]])
    ends, angles = dihedral_angles(Mesh(vertices, faces))
    assert ends.tolist() == [[0, 1]] and angles == pytest.approx([np.pi / 2])
    vertices[2:, 2] = 1.0
    assert dihedral_angles(Mesh(vertices, faces))[1] == pytest.approx([-np.pi / 2])


def test_a_cylinder_is_curved_by_1_over_its_radius_along_its_axis_alone():
    mesh = cylinder(radius=2.0)
    inside = (mesh.vertices[:, 2] > 1.5) & (mesh.vertices[:, 2] < 4.5)
    tensors = curvature_tensors(mesh, 3)[inside]
    np.testing.assert_allclose(tensors[:, 2, 2], 0.5, rtol=0.02)
    assert np.abs(tensors[:, :2, :2]).max() < 0.02


def test_the_direction_of_small_curvature_is_the_axis_of_a_cylinder():
    mesh = cylinder()
    directions = principal_directions(mesh, curvature_tensors(mesh, 3))
    heights = mesh.vertices[mesh.faces].mean(1)[:, 2]
    inside = (heights > 1.5) & (heights < 4.5)
    assert np.abs(directions[inside, 0, 2]).min() > 0.999
    assert np.abs(directions[inside, 1, 2]).max() < 0.05
    # of a valley too: seen from inside, the axis is where the curvature is largest
    hollow = Mesh(mesh.vertices, mesh.faces[:, ::-1])
    directions = principal_directions(hollow, curvature_tensors(hollow, 3))
    assert np.abs(directions[inside, 1, 2]).min() > 0.999


def test_a_sphere_is_curved_alike_everywhere():
    mesh = icosphere(3)
    found = np.linalg.eigvalsh(curvature_tensors(mesh, 2))
    np.testing.assert_allclose(found[:, 1:], 1, atol=0.1)
    np.testing.assert_allclose(found[:, 0], 0, atol=0.1)


def test_directions_are_orthonormal_and_turn_with_the_mesh():
    mesh = bumpy_sphere()
    q, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    q *= np.sign(np.linalg.det(q))
    turned = Mesh(mesh.vertices @ q.T, mesh.faces)
    one, two = (principal_directions(m, curvature_tensors(m, 2)) for m in (mesh, turned))
    gram = np.einsum("fai,fbi->fab", one, one)
    np.testing.assert_allclose(gram, np.tile(np.eye(2), (len(gram), 1, 1)), atol=1e-12)
    agree = np.abs(np.einsum("fi,fi->f", two[:, 0], one[:, 0] @ q.T))
    assert np.quantile(agree, 0.02) > 0.999
    normals = mesh.face_normals / np.linalg.norm(mesh.face_normals, axis=1, keepdims=True)
    np.testing.assert_allclose(np.cross(one[:, 0], one[:, 1]), normals, atol=1e-12)


def test_planes_bow_ties_and_flat_faces_are_borne():
    flat = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 5, 5]]), np.array([[0, 1, 2]]))
    for mesh in (lattice(4, 4), bow_tie(), flat):
        tensors = curvature_tensors(mesh, 2)
        assert np.isfinite(tensors).all()
        assert np.isfinite(principal_directions(mesh, tensors)).all()
    assert not curvature_tensors(lattice(4, 4), 2).any()
