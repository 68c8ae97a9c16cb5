"""Scans: usable with remarks, or refused in one message that says whether a repair helps."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from meshspiral.data.mesh_files import SUFFIXES
from meshspiral.data.scans import open_scan, scan
from meshspiral.geometry.mesh import MeshError
from tests.meshes import bumpy_sphere, lattice

SPHERE = bumpy_sphere()
V, F = SPHERE.vertices, SPHERE.faces


def test_a_mesh_without_defects_has_no_remarks():
    found = scan(V, F, "a")
    assert found.remarks == [] and not found.repaired
    np.testing.assert_array_equal(found.vertex_of, np.arange(len(V)))
    np.testing.assert_array_equal(found.mesh.faces, F)


@pytest.mark.parametrize(
    "vertices, faces, remark",
    [
        (np.concatenate([V, V + 9]), np.concatenate([F, F + len(V)]), "components: 2"),
        (V, F[5:], "small holes closed for the labels, with faces: 5"),
        (V, F[: len(F) // 2], "the surface has a boundary"),
        (
            V[F.ravel()],
            np.arange(F.size).reshape(-1, 3),
            "vertices at the position of another: 798",
        ),
        (np.concatenate([V[:1], V]), F + 1, "vertices on no face, without a match: 1 of 163"),
        (V, F[:, ::-1], "inside-out components turned outwards: 1"),
        (
            np.concatenate([V, V[:1], V[:1]]),
            np.concatenate([F, [[0, 162, 163]]]),
            "faces of zero area: 1",
        ),
    ],
)
def test_a_defect_that_does_no_harm_is_remarked(vertices, faces, remark):
    found = scan(vertices, faces, "a")
    assert any(remark in line for line in found.remarks), found.remarks
    used = found.vertex_of >= 0
    np.testing.assert_array_equal(found.mesh.vertices[found.vertex_of[used]], vertices[used])
    assert set(np.unique(faces)) == set(np.flatnonzero(used))


def test_a_surface_that_was_inside_out_faces_outwards():
    np.testing.assert_allclose(scan(V, F[:, ::-1], "a").mesh.face_normals, SPHERE.face_normals)
    opened = scan(V, F[9:, ::-1], "a")
    assert opened.remarks[0] == "inside-out components turned outwards: 1"
    np.testing.assert_allclose(opened.mesh.face_normals[:311], SPHERE.face_normals[9:])


def test_each_component_is_turned_by_itself_and_a_sheet_never():
    faces = np.concatenate([F, F[:, ::-1] + len(V)])
    found = scan(np.concatenate([V, 0.3 * V + 9]), faces, "a")
    assert "inside-out components turned outwards: 1" in found.remarks
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


def test_isolated_vertices_are_no_components():
    found = scan(np.concatenate([V, [[5, 5, 5], [6, 6, 6]]]), F, "a")
    assert found.remarks == ["vertices on no face, without a match: 2 of 164"]


def test_a_mesh_that_cannot_be_used_says_that_a_repair_helps():
    bad = V.copy()
    bad[[4, 7]] = np.nan
    with pytest.raises(MeshError, match=r"a: 2 vertices with .* vertex 4 = .*; repair=true fixes"):
        scan(bad, F, "a")
    found = scan(bad, F, "a", repair=True)
    assert np.flatnonzero(found.vertex_of < 0).tolist() == [4, 7]
    [remark] = [remark for remark in found.remarks if remark.startswith("repaired: 2 vertices")]
    assert "not finite" in remark and found.repaired


@pytest.mark.parametrize("scale", [0.0, 1e-160, 1e-101, 1e101, 1e200])
def test_an_extent_that_float64_cannot_square_is_refused(scale):
    with pytest.raises(MeshError, match=r"^a: the extent must be 1e-70 to 1e\+70, got"):
        scan(V * scale, F, "a")


def test_a_surface_without_faces_or_area_is_refused():
    with pytest.raises(MeshError, match=r"^a: a surface must have at least 1 face, got 0$"):
        scan(V, F[:0], "a")
    with pytest.raises(MeshError, match=r"^a: the surface area must be above 0, got 0$"):
        scan(V * [1, 0, 0], F, "a")


def test_files_without_a_mesh_are_refused_in_one_line(tmp_path):
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
        with pytest.raises(MeshError) as error:
            open_scan(tmp_path / name)
        assert name in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(MeshError, match="No such file"):
        open_scan(tmp_path / "none.ply")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_keeps_the_vertices(suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    trimesh.Trimesh(V, F, process=False).export(path)
    found = open_scan(path)
    if suffix == ".stl":  # vertices are numbered anew
        assert len(found.vertices) == len(V)
    else:
        np.testing.assert_allclose(found.vertices, V, atol=1e-6)
        np.testing.assert_array_equal(found.faces, F)


def test_a_scene_becomes_one_mesh_with_its_parts_transformed(tmp_path):
    part = trimesh.Trimesh(V, F, process=False)
    scene = trimesh.Scene([part])
    scene.add_geometry(part, transform=trimesh.transformations.translation_matrix([9, 0, 0]))
    scene.export(tmp_path / "a.glb")
    found = open_scan(tmp_path / "a.glb")
    both = np.concatenate([V, V + np.array([9, 0, 0])])
    np.testing.assert_allclose(found.vertices, both, atol=1e-6)


def test_quads_are_triangulated(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    assert len(open_scan(tmp_path / "a.obj").mesh.faces) == 2
