"""Meshes: area and normals are correct, and what breaks a rule is refused by name."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.geometry.mesh import Mesh, MeshError, used_vertices
from tests.meshes import bumpy_sphere, lattice

SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]


def test_area_and_normals_of_a_lattice():
    mesh = lattice(4, 5)
    assert mesh.area == pytest.approx(3 * 4 * 2 * np.sqrt(3) / 4)
    np.testing.assert_allclose(mesh.vertex_normals, np.tile([0, 0, 1], (20, 1)), atol=1e-12)


def test_vertex_normals_weigh_faces_by_area():
    # at vertex 0, a face of area 2 with normal z and one of area 1/2 with normal x
    mesh = Mesh([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 0.5]], [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_allclose(mesh.vertex_normals[0], np.array([1, 0, 4]) / np.sqrt(17))


def test_an_isolated_vertex_has_no_normal():
    mesh = Mesh([*SQUARE, [9, 9, 9]], [[0, 1, 2], [0, 2, 3]])
    assert np.isnan(mesh.vertex_normals[4]).all()
    np.testing.assert_allclose(mesh.vertex_normals[:4], [[0, 0, 1]] * 4)


@pytest.mark.parametrize(
    "vertices, faces, message",
    [
        (
            [[0, 0, np.nan], [1, 0, 0], [0, np.inf, 0]],
            [[0, 1, 2]],
            r"2 vertices with coordinates that are not finite: vertex 0 = \(0, 0, nan\); vertex 2",
        ),
        (
            SQUARE,
            [[0, 1, 2], [0, 2, 4]],
            r"1 face naming a vertex outside 0..3: face 1 = \(0, 2, 4\)",
        ),
        (SQUARE, [[0, 1, -1]], r"outside 0..3"),
        (SQUARE, [[0, 1, 2], [2, 3, 3]], r"1 face naming a vertex twice: face 1 = \(2, 3, 3\)"),
        (
            [*SQUARE, [0, 0, 1], [0, 0, -1]],
            [[0, 1, 2], [0, 1, 4], [0, 1, 5]],
            r"1 edge with more than two faces: \(0, 1\)",
        ),
        (SQUARE, [[0, 1, 2], [0, 3, 2], [0, 2, 3]], r"1 edge with more than two faces: \(0, 2\)"),
        (SQUARE, [[0, 1, 2], [0, 3, 2], [1, 3, 0]], r"wound against each other: \("),
        (np.zeros((0, 3)), [], r"vertices must be \[V, 3\] with V > 0"),
        (SQUARE, [[0, 1, 2, 3]], r"faces must be triangles"),
        (SQUARE, [[0.0, 1.0, 2.0]], r"faces must be integers"),
    ],
)
def test_a_broken_rule_is_reported_with_count_and_first_offenders(vertices, faces, message):
    with pytest.raises(MeshError, match=message) as caught:
        Mesh(vertices, faces, "bad.ply")
    assert str(caught.value).startswith("bad.ply: ")
    assert "\n" not in str(caught.value)


def test_a_moebius_strip_is_refused():
    k = np.arange(10)
    vertices = np.random.default_rng(0).random((10, 3))
    faces = np.stack([k, (k + 1) % 10, (k + 2) % 10], 1)
    faces[1::2] = faces[1::2, ::-1]
    Mesh(vertices, faces)  # an even number of turned triangles closes to a band
    with pytest.raises(MeshError, match="wound against each other"):
        odd = np.stack([k[:9], (k[:9] + 1) % 9, (k[:9] + 2) % 9], 1)
        odd[1::2] = odd[1::2, ::-1]
        Mesh(vertices[:9], odd)


def test_meshes_without_faces_or_area_are_accepted():
    assert Mesh([[0, 0, 0]], []).faces.shape == (0, 3)
    point = Mesh([[0, 0, 0], [0, 0, 0], [0, 0, 0]], [[0, 1, 2]])
    assert point.area == 0
    assert np.isnan(point.vertex_normals).all()


def test_renumbered_is_the_same_surface():
    mesh = bumpy_sphere()
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    other = mesh.renumbered(order)
    np.testing.assert_array_equal(other.vertices[other.faces], mesh.vertices[mesh.faces])
    np.testing.assert_array_equal(other.vertices, mesh.vertices[order])


def test_vertices_in_use_and_faces_as_indices_of_them():
    used, faces = used_vertices(np.array([[7, 2, 9], [9, 2, 4]]))
    assert used.tolist() == [2, 4, 7, 9]
    assert faces.tolist() == [[2, 0, 3], [3, 0, 1]]


def test_the_size_is_that_of_the_complete_surface():
    mesh = Mesh(np.eye(3), [[0, 1, 2]])
    assert mesh.size == pytest.approx(np.sqrt(np.sqrt(3) / 2))
    part = Mesh(np.eye(3), [[0, 1, 2]], "a", complete_area=4.0)
    assert part.size == 2.0 and part.renumbered(np.array([2, 0, 1])).size == 2.0
    assert part.with_faces(np.array([[0, 2, 1]])).size == 2.0
