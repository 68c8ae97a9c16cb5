"""Another density of vertices: the same surface, and where on it the old vertices lie."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.geometry.mesh import Mesh, MeshError
from meshspiral.geometry.remesh import closest_points
from meshspiral.geometry.resample import resample, surplus, without_repeats
from tests.meshes import bumpy_sphere, lattice, punctured

SPHERE = bumpy_sphere(subdivisions=4)  # 2562 vertices


@pytest.mark.parametrize(
    "mesh", [SPHERE, bumpy_sphere(subdivisions=1), lattice(30, 30), punctured(SPHERE, 0.01)]
)
@pytest.mark.parametrize("count", [150, 1200])
def test_the_surface_stays_and_the_old_vertices_lie_on_it(mesh, count):
    found = resample(mesh, count)
    assert 0.8 * count <= len(found.mesh.vertices) <= 1.3 * count  # VTK counts faces
    used = np.unique(mesh.faces)
    points = np.einsum("vk,vkx->vx", found.weights, found.mesh.vertices[found.corners])
    off = np.linalg.norm(points - mesh.vertices, axis=1)[used]
    # half the sagitta's order, edge^2 / radius, on a surface of radius 1
    assert off.max() < 4 * found.mesh.area / count
    np.testing.assert_allclose(found.weights.sum(axis=1), 1)
    assert found.mesh.area == pytest.approx(mesh.area, rel=0.05)


def test_more_vertices_change_no_point_of_the_surface():
    coarse = bumpy_sphere(subdivisions=1)
    found = resample(coarse, 162)
    points = np.einsum("vk,vkx->vx", found.weights, found.mesh.vertices[found.corners])
    np.testing.assert_allclose(points, coarse.vertices, atol=1e-6)


def test_a_third_face_at_an_edge_is_surplus():
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    assert surplus(faces, 5).tolist() == [2]
    assert surplus(faces[:2], 5).tolist() == []


def test_faces_that_are_none_go_and_repeated_ones_stay_once():
    faces = np.array([[0, 1, 2], [2, 1, 0], [3, 3, 1], [1, 2, 3]])
    np.testing.assert_array_equal(without_repeats(faces), faces[[0, 3]])


def test_a_surface_that_would_vanish_is_refused():
    with pytest.raises(MeshError, match="nothing is left"):
        resample(Mesh(np.eye(3), np.array([[0, 1, 2]]), "a"), 3)


def test_a_vertex_without_a_normal_still_has_a_closest_point():
    points, nowhere = SPHERE.vertices[:3], np.full((3, 3), np.nan)
    face, _, distance = closest_points(SPHERE, points, nowhere)
    assert (distance < 1e-9).all()
    assert all(vertex in SPHERE.faces[f] for vertex, f in enumerate(face))
