"""Meshes as they come: handled and said, or refused in one line that says what would help."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from meshspiral.data.attributes import read_attribute
from meshspiral.data.scans import open_scan, scan
from meshspiral.data.shapes import DataError
from meshspiral.geometry.mesh import SUFFIXES, MeshError
from tests.meshes import bumpy_sphere, lattice

SPHERE = bumpy_sphere()
V, F = SPHERE.vertices, SPHERE.faces


def test_a_sound_mesh_has_no_remarks():
    found = scan(V, F, "a")
    assert found.remarks == []
    np.testing.assert_array_equal(found.place, np.arange(len(V)))
    np.testing.assert_array_equal(found.mesh.faces, F)


@pytest.mark.parametrize(
    "vertices, faces, remark",
    [
        (np.concatenate([V, V + 9]), np.concatenate([F, F + len(V)]), "2 components"),
        (V, F[5:], "the surface has a boundary"),
        (V[F.ravel()], np.arange(F.size).reshape(-1, 3), "798 vertices are at the place of"),
        (np.concatenate([V[:1], V]), F + 1, "1 of 163 vertices are on no face"),
        (V, F[:, ::-1], "inside out"),
        (
            np.concatenate([V, V[:1], V[:1]]),
            np.concatenate([F, [[0, 162, 163]]]),
            "1 faces without",
        ),
    ],
)
def test_what_can_be_used_is_used_and_said(vertices, faces, remark):
    found = scan(vertices, faces, "a")
    assert any(remark in line for line in found.remarks), found.remarks
    there = found.place >= 0
    np.testing.assert_array_equal(found.mesh.vertices[found.place[there]], vertices[there])
    assert set(np.unique(faces)) == set(np.flatnonzero(there))


def test_a_surface_that_was_inside_out_faces_outwards():
    np.testing.assert_allclose(scan(V, F[:, ::-1], "a").mesh.face_normals, SPHERE.face_normals)
    opened = scan(V, F[9:, ::-1], "a")
    assert opened.remarks[0] == "1 pieces of the surface were inside out and have been turned"
    np.testing.assert_allclose(opened.mesh.face_normals, SPHERE.face_normals[9:])


def test_each_piece_is_turned_by_itself_and_a_sheet_is_left():
    faces = np.concatenate([F, F[:, ::-1] + len(V)])
    found = scan(np.concatenate([V, 0.3 * V + 9]), faces, "a")
    assert "1 pieces of the surface were inside out and have been turned" in found.remarks
    assert (found.mesh.face_normals[len(F) :] * SPHERE.face_normals > 0).any(axis=1).all()
    sheet = lattice(5, 6)
    for wound in (sheet.faces, sheet.faces[:, ::-1]):
        np.testing.assert_array_equal(scan(sheet.vertices, wound, "a").mesh.faces, wound)


def test_a_repair_that_follows_a_wrong_face_still_faces_outwards():
    faces = F[20:].copy()
    faces[:40] = faces[:40, ::-1]
    found = scan(V, faces, "a", repair=True)
    outward = found.mesh.face_normals[: len(faces)] * SPHERE.face_normals[20:]
    assert (outward.sum(axis=1) > 0).all()


def test_vertices_on_no_face_are_no_components():
    found = scan(np.concatenate([V, [[5, 5, 5], [6, 6, 6]]]), F, "a")
    assert found.remarks == ["2 of 164 vertices are on no face and get no match"]


def test_what_cannot_be_used_says_what_would_mend_it():
    bad = V.copy()
    bad[[4, 7]] = np.nan
    with pytest.raises(MeshError, match=r"a: 2 vertices with .* vertex 4 = .*; repair=true mends"):
        scan(bad, F, "a")
    found = scan(bad, F, "a", repair=True)
    assert np.flatnonzero(found.place < 0).tolist() == [4, 7]
    assert any("2 vertices with coordinates that are not finite" in x for x in found.remarks)


@pytest.mark.parametrize("scale", [0.0, 1e-160, 1e-101, 1e101, 1e200])
def test_a_size_without_numbers_is_refused(scale):
    with pytest.raises(MeshError, match=r"across, which is no surface to describe"):
        scan(V * scale, F, "a")


def test_a_mesh_without_faces_is_refused():
    with pytest.raises(MeshError, match="no faces"):
        scan(V, F[:0], "a")


def test_files_that_hold_no_mesh_are_refused_in_one_line(tmp_path):
    mesh = trimesh.Trimesh(V, F, process=False)
    whole = mesh.export(file_type="ply")
    files = {
        "empty.ply": b"",
        "text.ply": b"hello\nworld\n",
        "cut.ply": whole[: len(whole) // 2],
        "huge.ply": whole.replace(b"element vertex 162", b"element vertex 4294967295"),
        "many.ply": whole.replace(b"element face 320", b"element face 4294967295"),
        "points.ply": trimesh.PointCloud(V).export(file_type="ply"),
        "noise.glb": bytes(range(256)) * 9,
        "other.xyz": b"1 2 3\n",
        "huge.stl": bytes(80) + b"\xff\xff\xff\xff" + bytes(500),
        "huge.off": b"OFF\n4294967295 4294967295 0\n0 0 0\n",
        "index.off": b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n",
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(MeshError) as told:
            open_scan(tmp_path / name)
        assert name in str(told.value) and "\n" not in str(told.value)
    with pytest.raises(MeshError, match="No such file"):
        open_scan(tmp_path / "none.ply")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_keeps_the_vertices(suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    trimesh.Trimesh(V, F, process=False).export(path)
    found = open_scan(path)
    if suffix == ".stl":  # it has no vertices of its own
        assert len(found.vertices) == len(V)
    else:
        np.testing.assert_allclose(found.vertices, V, atol=1e-6)
        np.testing.assert_array_equal(found.faces, F)


def test_a_scene_is_one_mesh_with_its_parts_in_place(tmp_path):
    part = trimesh.Trimesh(V, F, process=False)
    scene = trimesh.Scene([part])
    scene.add_geometry(part, transform=trimesh.transformations.translation_matrix([9, 0, 0]))
    scene.export(tmp_path / "a.glb")
    found = open_scan(tmp_path / "a.glb")
    both = np.concatenate([V, V + np.array([9, 0, 0])])
    np.testing.assert_allclose(found.vertices, both, atol=1e-6)


def test_quads_are_cut_into_triangles(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    assert len(open_scan(tmp_path / "a.obj").mesh.faces) == 2


# --------------------------------------------------------------------------------- attributes


def test_colours_are_read(tmp_path):
    colors = np.random.default_rng(0).integers(256, size=(len(V), 4)).astype(np.uint8)
    colored = trimesh.Trimesh(V, F, vertex_colors=colors, process=False)
    for suffix in (".ply", ".obj", ".glb"):
        path = tmp_path / f"a{suffix}"
        colored.export(path)
        np.testing.assert_allclose(read_attribute(path, "color", len(V)), colors[:, :3], atol=1)


def test_texture_coordinates_are_read_at_a_seam_the_first(tmp_path):
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


def test_a_texture_does_not_give_a_ply_other_vertices(tmp_path):
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


def test_an_array_of_anything_is_read(tmp_path):
    path = tmp_path / "a.ply"
    values = np.arange(162 * 6.0).reshape(162, 2, 3)
    np.save(tmp_path / "x.npy", values)
    np.testing.assert_array_equal(read_attribute(path, str(tmp_path / "x.npy"), 162), values)


def test_what_is_not_there_is_said(tmp_path):
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
