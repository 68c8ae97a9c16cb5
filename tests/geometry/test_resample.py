"""Resampling: the surface stays, and the vertices of the source lie on it."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.geometry.barycentric import interpolate
from meshspiral.geometry.mesh import Mesh, MeshError
from meshspiral.geometry.remesh import closest_points
from meshspiral.geometry.resample import resample
from tests.meshes import bumpy_sphere, lattice, punctured

SPHERE = bumpy_sphere(subdivisions=4)  # 2562 vertices


@pytest.mark.parametrize(
    "mesh", [SPHERE, bumpy_sphere(subdivisions=1), lattice(30, 30), punctured(SPHERE, 0.01)]
)
@pytest.mark.parametrize("count", [150, 1200])
def test_the_surface_stays_and_the_source_lies_on_it(mesh, count):
    found = resample(mesh, count)
    assert 0.8 * count <= len(found.mesh.vertices) <= 1.3 * count  # VTK counts faces
    used = np.unique(mesh.faces)
    points = interpolate(found.mesh.vertices, found.corners, found.weights)
    off = np.linalg.norm(points - mesh.vertices, axis=1)[used]
    # half the order of the sagitta, edge^2 / radius, on a surface of radius 1
    assert off.max() < 4 * found.mesh.area / count
    np.testing.assert_allclose(found.weights.sum(axis=1), 1)
    assert found.mesh.area == pytest.approx(mesh.area, rel=0.05)


def test_more_vertices_leave_the_surface_unchanged():
    coarse = bumpy_sphere(subdivisions=1)
    found = resample(coarse, 162)
    points = interpolate(found.mesh.vertices, found.corners, found.weights)
    np.testing.assert_allclose(points, coarse.vertices, atol=1e-6)


def test_a_surface_that_would_vanish_is_refused():
    with pytest.raises(MeshError, match=r"a: nothing is left of the surface .* 3 vertices"):
        resample(Mesh(np.eye(3), np.array([[0, 1, 2]]), "a"), 3)


def test_a_mesh_without_faces_is_refused():
    with pytest.raises(MeshError, match="a: no faces"):
        resample(Mesh(np.eye(3), [], "a"), 100)


def test_a_vertex_without_a_normal_still_has_a_closest_point():
    points, normals = SPHERE.vertices[:3], np.full((3, 3), np.nan)
    face, _, distance = closest_points(SPHERE, points, normals)
    assert (distance < 1e-9).all()
    assert all(vertex in SPHERE.faces[f] for vertex, f in enumerate(face))
