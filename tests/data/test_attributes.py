"""Attributes of vertices: colours, texture coordinates, and arrays of any shape."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from meshspiral.data.attributes import read_attribute
from meshspiral.data.scans import open_scan
from meshspiral.data.shapes import DataError
from tests.meshes import bumpy_sphere, lattice

SPHERE = bumpy_sphere()
V, F = SPHERE.vertices, SPHERE.faces


def test_colours_are_read(tmp_path):
    colors = np.random.default_rng(0).integers(256, size=(len(V), 4)).astype(np.uint8)
    colored = trimesh.Trimesh(V, F, vertex_colors=colors, process=False)
    for suffix in (".ply", ".obj", ".glb"):
        path = tmp_path / f"a{suffix}"
        colored.export(path)
        np.testing.assert_allclose(read_attribute(path, "color", len(V)), colors[:, :3], atol=1)


def test_texture_coordinates_are_read_and_at_a_seam_the_first_count(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
        "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvt .5 .5\nf 1/1 2/2 3/3\nf -4/5 -2/-2 -1/-2\n"
    )
    expected = [[0, 0], [1, 0], [1, 1], [0, 1]]
    np.testing.assert_array_equal(read_attribute(path, "uv", 4), expected)
    uv = np.random.default_rng(0).random((len(V), 2))
    visual = trimesh.visual.TextureVisuals(uv=uv)
    trimesh.Trimesh(V, F, visual=visual, process=False).export(tmp_path / "a.glb")
    np.testing.assert_allclose(read_attribute(tmp_path / "a.glb", "uv", len(V)), uv, atol=1e-6)


def test_a_texture_does_not_split_the_vertices_of_a_ply(tmp_path):
    rows = "\n".join(" ".join(map(str, v)) for v in V)
    faces = "\n".join(f"3 {a} {b} {c} 6 0 0 1 0 0 1" for a, b, c in F)
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\ncomment TextureFile a.png\n"
        f"element vertex {len(V)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(F)}\nproperty list uchar int vertex_indices\n"
        f"property list uchar float texcoord\nend_header\n{rows}\n{faces}\n"
    )
    found = open_scan(tmp_path / "a.ply")
    np.testing.assert_allclose(found.vertices, V)
    np.testing.assert_array_equal(found.faces, F)
    with pytest.raises(DataError, match="have no uv"):
        read_attribute(tmp_path / "a.ply", "uv", len(V))


def test_colours_of_an_obj_may_go_to_255_and_uv_may_be_missing(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(
        "v 0 0 0 255 0 9\nv 1 0 0 0 0 0\nv 0 1 0 1 2 3\nv 2 2 2 1 1 1\nvt 0 0\n"
        "f 1/1 2/1 3/1\nf 2 4 3\n"
    )
    np.testing.assert_array_equal(read_attribute(path, "color", 4)[0], [255, 0, 9])
    with pytest.raises(DataError, match="1 of the 4 vertices of faces have no uv"):
        read_attribute(path, "uv", 4)


def test_an_array_of_any_shape_is_read(tmp_path):
    path = tmp_path / "a.ply"
    values = np.arange(162 * 6.0).reshape(162, 2, 3)
    np.save(tmp_path / "x.npy", values)
    np.testing.assert_array_equal(read_attribute(path, str(tmp_path / "x.npy"), 162), values)


def test_a_missing_attribute_is_reported(tmp_path):
    mesh = lattice(3, 3)
    for suffix in (".ply", ".obj"):
        path = tmp_path / f"a{suffix}"
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
        for what in ("color", "uv"):
            with pytest.raises(DataError, match=f"its vertices have no {what}"):
                read_attribute(path, what, 9)
    with pytest.raises(DataError, match="transfer must be"):
        read_attribute(path, "colour", 9)
    np.save(tmp_path / "x.npy", np.zeros(8))
    with pytest.raises(DataError, match=r"8 values of .* for 9 vertices"):
        read_attribute(path, str(tmp_path / "x.npy"), 9)
    np.save(tmp_path / "bad.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(DataError, match="no array that can be read"):
        read_attribute(path, str(tmp_path / "bad.npy"), 9)
