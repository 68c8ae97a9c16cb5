"""ZoomOut: a noisy map of a surface to itself becomes nearly the identity."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from meshspiral.geometry.mesh import Mesh, MeshError
from meshspiral.geometry.zoomout import TO, eigenfunctions, zoomout
from tests.meshes import bumpy_sphere

MESH = bumpy_sphere(subdivisions=3)


def test_eigenfunctions_are_orthonormal_and_those_of_the_sphere():
    sphere = trimesh.creation.icosphere(subdivisions=3)
    functions, masses = eigenfunctions(Mesh(sphere.vertices, sphere.faces), 9)
    np.testing.assert_allclose((functions.T * masses) @ functions, np.eye(9), atol=1e-8)
    assert masses.sum() == pytest.approx(4 * np.pi, rel=0.02)
    np.testing.assert_allclose(np.ptp(functions[:, 0]), 0, atol=1e-6)
    # the next three span the linear functions
    x = np.asarray(sphere.vertices)
    fitted = functions[:, 1:4] @ ((functions[:, 1:4].T * masses) @ x)
    np.testing.assert_allclose(fitted, x, atol=0.01)


def test_noise_is_removed_from_the_identity():
    """Between a surface and itself in another order, with another basis of eigenfunctions."""
    functions, masses = eigenfunctions(MESH, TO)
    rng = np.random.default_rng(0)
    identity = np.arange(len(masses))
    noisy = np.where(rng.random(len(masses)) < 0.3, rng.permutation(len(masses)), identity)
    order = rng.permutation(len(masses))
    place, others = np.argsort(order), functions[order].copy()
    for a, b in [(0, 20), *((k, k + 5) for k in range(20, TO, 5))]:  # those that a step adds
        others[:, a:b] = others[:, a:b] @ np.linalg.qr(rng.normal(size=(b - a, b - a)))[0]

    def error(match):
        return np.linalg.norm(MESH.vertices[match] - MESH.vertices, axis=1).mean()

    found = order[zoomout(functions, masses, others, place[noisy])]
    assert error(found) < 0.1 * error(noisy)


def test_the_identity_is_unchanged():
    functions, masses = eigenfunctions(MESH, TO)
    identity = np.arange(len(masses))
    np.testing.assert_array_equal(zoomout(functions, masses, functions, identity), identity)


def test_too_small_a_mesh_is_refused():
    with pytest.raises(MeshError, match="80 eigenfunctions need more than 80 vertices, got 42"):
        eigenfunctions(bumpy_sphere(subdivisions=1), 80)
