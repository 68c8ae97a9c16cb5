"""Meshes: what is read is what was written, and what cannot be used is refused by name."""

import numpy as np
import pytest
import trimesh

from meshspiral.geometry.mesh import Mesh, MeshError, parse_mesh, read_mesh
from tests.meshes import bumpy_sphere, lattice, punctured, random_meshes

SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]


def test_area_and_normals_of_a_lattice():
    mesh = lattice(4, 5)
    assert mesh.area == pytest.approx(3 * 4 * 2 * np.sqrt(3) / 4)
    np.testing.assert_allclose(mesh.vertex_normals, np.tile([0, 0, 1], (20, 1)), atol=1e-12)


def test_vertex_normals_weigh_faces_by_area():
    # at vertex 0 a face of area 2 looks along z and one of area 1/2 along x
    mesh = Mesh([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 0.5]], [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_allclose(mesh.vertex_normals[0], np.array([1, 0, 4]) / np.sqrt(17))


def test_a_vertex_without_a_face_has_no_normal():
    mesh = Mesh([*SQUARE, [9, 9, 9]], [[0, 1, 2], [0, 2, 3]])
    assert np.isnan(mesh.vertex_normals[4]).all()
    assert np.isfinite(mesh.vertex_normals[:4]).all()


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off"])
def test_reading_keeps_vertices_and_faces_as_they_stand(tmp_path, suffix):
    mesh = punctured(bumpy_sphere(), 0.3)  # some vertices are in no face
    path = tmp_path / f"mesh{suffix}"
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
    read = read_mesh(path)
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    assert read.vertices.dtype == np.float64 and read.faces.dtype == np.int32


def test_stl_corners_at_one_place_become_one_vertex(tmp_path):
    mesh = bumpy_sphere()
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / "mesh.stl")
    read = read_mesh(tmp_path / "mesh.stl")
    assert read.vertices.shape == mesh.vertices.shape
    np.testing.assert_allclose(read.vertices[read.faces], mesh.vertices[mesh.faces], atol=1e-6)
    first_seen = read.faces.ravel()[np.sort(np.unique(read.faces, return_index=True)[1])]
    np.testing.assert_array_equal(first_seen, np.arange(len(read.vertices)))


def test_obj_texture_and_materials_split_no_vertices():
    text = b"""mtllib none.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 7 7 7
v 2 0 0
vt 0 0
vt 1 1
usemtl a
f 1/1 2/2 3/1 4/2
usemtl b
f 2//1 6/1/1 3
v 2 1 0
f -2 -1 3
"""
    mesh = parse_mesh(text, ".obj", "textured.obj")
    assert len(mesh.vertices) == 7
    faces = {tuple(sorted(face)) for face in mesh.faces.tolist()}
    assert faces == {(0, 1, 2), (0, 2, 3), (1, 2, 5), (2, 5, 6)}


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
def test_what_cannot_be_used_is_refused_with_count_and_first_offenders(vertices, faces, message):
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


def test_odd_meshes_are_meshes():
    assert len(Mesh([[0, 0, 0]], []).faces) == 0
    Mesh([[0, 0, 0], [0, 0, 0], [0, 0, 0]], [[0, 1, 2]])  # no area
    assert len(random_meshes()) == 6


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".stl"])
@pytest.mark.parametrize("content", [b"", b"hello\n", b"ply\nformat ascii 1.0\n", bytes(200)])
def test_damaged_files_are_one_message(tmp_path, suffix, content):
    path = tmp_path / f"bad{suffix}"
    path.write_bytes(content)
    with pytest.raises(MeshError, match=r"bad\.\w+: (the file|not a readable)"):
        read_mesh(path)


def test_truncated_files_are_one_message(tmp_path):
    mesh = bumpy_sphere()
    for suffix in ("ply", "off"):
        whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type=suffix)
        whole = whole if isinstance(whole, bytes) else whole.encode()
        with pytest.raises(MeshError):
            parse_mesh(whole[: len(whole) // 2], f".{suffix}", f"half.{suffix}")


def test_missing_file_unknown_format_and_point_cloud(tmp_path):
    with pytest.raises(MeshError, match=r"none\.ply: No such file"):
        read_mesh(tmp_path / "none.ply")
    with pytest.raises(MeshError, match=r"known are \.ply, \.obj, \.off, \.stl"):
        read_mesh(tmp_path / "mesh.xyz")
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "points.ply")
    with pytest.raises(MeshError, match="no triangle mesh"):
        read_mesh(tmp_path / "points.ply")


def test_renumbered_is_the_same_surface():
    mesh = bumpy_sphere()
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    other = mesh.renumbered(order)
    np.testing.assert_array_equal(other.vertices[other.faces], mesh.vertices[mesh.faces])
    np.testing.assert_array_equal(other.vertices, mesh.vertices[order])
