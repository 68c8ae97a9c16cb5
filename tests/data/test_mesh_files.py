"""Mesh files: what is read is what was written, and unusable files are refused in one line."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from meshspiral.data.mesh_files import obj_statements, parse_mesh, read_mesh
from meshspiral.geometry.mesh import MeshError
from tests.meshes import bumpy_sphere, punctured


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off"])
def test_reading_preserves_the_order_of_vertices_and_faces(tmp_path, suffix):
    mesh = punctured(bumpy_sphere(), 0.3)  # with isolated vertices
    path = tmp_path / f"mesh{suffix}"
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
    read = read_mesh(path)
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    assert read.vertices.dtype == np.float64 and read.faces.dtype == np.int32


def test_stl_corners_at_equal_coordinates_become_one_vertex(tmp_path):
    mesh = bumpy_sphere()
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / "mesh.stl")
    read = read_mesh(tmp_path / "mesh.stl")
    assert read.vertices.shape == mesh.vertices.shape
    np.testing.assert_allclose(read.vertices[read.faces], mesh.vertices[mesh.faces], atol=1e-6)
    first_seen = read.faces.ravel()[np.sort(np.unique(read.faces, return_index=True)[1])]
    np.testing.assert_array_equal(first_seen, np.arange(len(read.vertices)))


def test_obj_texture_and_materials_do_not_split_vertices():
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


def test_obj_statements_have_absolute_numbers_and_continued_lines():
    text = (
        b"# v 9 9 9\nv 0 0 \\\n1 .5 .5 .5\r\nvt 0 1\nvn 0 0 1\n\tf 1/1 -1/-1/-1 1//1 -1\nvt 2 2\n"
    )
    assert list(obj_statements(text)) == [
        ("v", ["0", "0", "1", ".5", ".5", ".5"]),
        ("vt", ["0", "1"]),
        ("f", [("1", "1"), ("1", "1"), ("1", ""), ("1", "")]),
        ("vt", ["2", "2"]),
    ]


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".stl"])
@pytest.mark.parametrize("content", [b"", b"hello\n", b"ply\nformat ascii 1.0\n", bytes(200)])
def test_a_damaged_file_is_refused_by_name(tmp_path, suffix, content):
    path = tmp_path / f"bad{suffix}"
    path.write_bytes(content)
    with pytest.raises(MeshError, match=r"bad\.\w+: (the file|not a readable)"):
        read_mesh(path)


@pytest.mark.parametrize("suffix", [".ply", ".off"])
def test_a_truncated_file_is_refused_by_name(suffix):
    mesh = bumpy_sphere()
    data = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type=suffix[1:])
    data = data if isinstance(data, bytes) else data.encode()
    with pytest.raises(MeshError, match=rf"half\{suffix}: not a readable"):
        parse_mesh(data[: len(data) // 2], suffix, f"half{suffix}")


def test_a_missing_file_an_unknown_format_and_a_point_cloud_are_refused(tmp_path):
    with pytest.raises(MeshError, match=r"none\.ply: No such file"):
        read_mesh(tmp_path / "none.ply")
    with pytest.raises(MeshError, match=r"known are \.ply, \.obj, \.off, \.stl"):
        read_mesh(tmp_path / "mesh.xyz")
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "points.ply")
    with pytest.raises(MeshError, match="no triangle mesh"):
        read_mesh(tmp_path / "points.ply")
