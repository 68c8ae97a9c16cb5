"""What `export=` writes: dense points, the template's connectivity, an animated file."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from meshspiral import Matcher, scan
from meshspiral.commands.match import main
from meshspiral.data.datasets.bodies import Bodies
from meshspiral.evaluation.distributions import Distributions
from meshspiral.geometry.barycentric import interpolate
from meshspiral.geometry.mesh import Mesh
from meshspiral.matching import export
from meshspiral.matching.dense import dense_map
from meshspiral.matching.job import FileMatch, LabelledScan
from meshspiral.matching.matcher import Labels
from meshspiral.matching.morph import morph_glb
from meshspiral.matching.pictures import align_to_template
from meshspiral.matching.registration import registered, spanning_faces

BODIES = Bodies(1500)
TEMPLATE = BODIES.template
SQUAT, WALK = BODIES.load("s9_squat").mesh, BODIES.load("s8_walk").mesh


def perfect(mesh, keep: np.ndarray | None = None) -> LabelledScan:
    """A body with its true labels; without the faces that are not kept."""
    faces = mesh.faces if keep is None else mesh.faces[keep[mesh.faces].all(axis=1)]
    opened = scan(mesh.vertices, faces, "a.ply")
    points = np.where(opened.vertex_of[:, None] >= 0, TEMPLATE.vertices, np.nan)
    template = np.where(opened.vertex_of >= 0, np.arange(1500), -1).astype(np.int32)
    sure = (template >= 0).astype(np.float32)
    nothing = Distributions(None, None, None, opened.vertex_of)
    return LabelledScan(opened, Labels(template, points, sure, sure), nothing)


def test_true_labels_register_the_body_itself():
    positions, confidence = registered(perfect(SQUAT), TEMPLATE)
    off = np.linalg.norm(positions - SQUAT.vertices, axis=1) / SQUAT.size
    assert np.median(off) < 1e-3 and off.max() < 0.02
    np.testing.assert_allclose(confidence, 1)


def test_a_missing_part_is_bridged_with_confidence_zero():
    height = SQUAT.vertices[:, 2]
    keep = height > np.quantile(height, 0.2)
    positions, confidence = registered(perfect(SQUAT, keep), TEMPLATE)
    assert np.isfinite(positions).all()
    assert (confidence[height < np.quantile(height, 0.1)] == 0).mean() > 0.9
    assert (confidence[keep] > 0.9).mean() > 0.98


def test_a_part_is_shown_in_the_size_that_it_has_in_the_whole():
    sizes = []
    for keep in (None, SQUAT.vertices[:, 2] > np.median(SQUAT.vertices[:, 2])):
        labelled = perfect(SQUAT, keep)
        shown = align_to_template(labelled.scan, labelled.labels, TEMPLATE)
        a, b, _ = shown.vertices[shown.faces].transpose(1, 0, 2)
        sizes.append(np.median(np.linalg.norm(a - b, axis=1)))
    own = SQUAT.vertices[labelled.scan.faces]
    upper = np.median(np.linalg.norm(own[:, 0] - own[:, 1], axis=1))
    a, b, _ = SQUAT.vertices[SQUAT.faces].transpose(1, 0, 2)
    whole = np.median(np.linalg.norm(a - b, axis=1))
    assert sizes[1] / upper == pytest.approx(sizes[0] / whole, rel=0.15)


def test_a_turned_body_is_shown_in_the_pose_of_the_template():
    turn = Rotation.from_rotvec([0.3, 2.0, -0.7])
    moved = Mesh(3 * turn.apply(TEMPLATE.vertices) + [5.0, -2, 1], TEMPLATE.faces)
    labelled = perfect(moved)
    shown = align_to_template(labelled.scan, labelled.labels, TEMPLATE)
    off = shown.vertices - TEMPLATE.vertices
    np.testing.assert_allclose(off - off.mean(axis=0), 0, atol=1e-6)


def test_the_morph_turns_the_source_into_its_counterparts(monkeypatch):
    monkeypatch.setattr(export, "morph_glb", lambda *shapes: shapes)
    source, target = perfect(SQUAT), perfect(WALK)
    match = FileMatch("a.ply", source, target, np.arange(1500), np.ones(1500, np.float32))
    start, end, faces, _ = export.morph_of(match, TEMPLATE, "y")
    for found, each in ((start, source), (end, target)):
        shown = align_to_template(each.scan, each.labels, TEMPLATE).vertices
        np.testing.assert_allclose(found, shown, atol=1e-5)
    np.testing.assert_array_equal(faces, SQUAT.faces)


def test_one_wrong_label_does_not_move_the_surface():
    labelled = perfect(SQUAT)
    labelled.labels.points[100] = TEMPLATE.vertices[700]
    positions, _ = registered(labelled, TEMPLATE)
    off = np.linalg.norm(positions - SQUAT.vertices, axis=1) / SQUAT.size
    assert off.max() < 0.05


def test_a_mesh_without_labels_registers_nowhere():
    labelled = perfect(SQUAT)
    labelled.labels.points[:] = np.nan
    positions, confidence = registered(labelled, TEMPLATE)
    assert np.isnan(positions).all() and (confidence == 0).all()


def test_faces_that_span_nothing():
    points = TEMPLATE.vertices.copy()
    face = TEMPLATE.faces[0]
    assert spanning_faces(points, TEMPLATE.faces, TEMPLATE).all()
    points[face[1]] = points[face[0]]
    assert not spanning_faces(points, TEMPLATE.faces, TEMPLATE)[0]
    points[face[1]] = np.nan
    assert not spanning_faces(points, TEMPLATE.faces, TEMPLATE)[0]


def test_the_dense_map_of_true_labels_is_the_true_one():
    corners, weights = dense_map(perfect(SQUAT), perfect(WALK), TEMPLATE)
    points = interpolate(WALK.vertices, corners, weights)
    np.testing.assert_allclose(points, WALK.vertices, atol=1e-6)
    np.testing.assert_allclose(weights.sum(axis=1), 1)


def test_a_source_vertex_between_target_vertices_gets_a_point_in_a_face():
    source = perfect(SQUAT)
    face = TEMPLATE.faces[40]
    source.labels.points[7] = TEMPLATE.vertices[face].mean(axis=0)
    corners, weights = dense_map(source, perfect(WALK), TEMPLATE)
    assert set(corners[7]) == set(face.tolist())
    np.testing.assert_allclose(weights[7], 1 / 3, atol=1e-3)


def test_the_morph_is_a_valid_file_with_both_shapes():
    colors = np.random.default_rng(0).random((1500, 3))
    data = morph_glb(SQUAT.vertices, WALK.vertices, SQUAT.faces, colors)
    magic, version, length = struct.unpack("<4sII", data[:12])
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size = struct.unpack("<I", data[12:16])[0]
    scene = json.loads(data[20 : 20 + size])
    binary = data[20 + size + 8 :]

    def array(index, dtype):
        accessor = scene["accessors"][index]
        view = scene["bufferViews"][accessor["bufferView"]]
        raw = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        return np.frombuffer(raw, dtype)

    primitive = scene["meshes"][0]["primitives"][0]
    start = array(primitive["attributes"]["POSITION"], np.float32).reshape(-1, 3)
    offset = array(primitive["targets"][0]["POSITION"], np.float32).reshape(-1, 3)
    np.testing.assert_allclose(start + offset, WALK.vertices, atol=1e-6)
    sampler = scene["animations"][0]["samplers"][0]
    assert array(sampler["output"], np.float32).tolist() == [0, 1, 0]
    loaded = trimesh.load(trimesh.util.wrap_as_stream(data), file_type="glb", force="mesh")
    assert len(loaded.faces) == len(SQUAT.faces)


@pytest.fixture
def files(tmp_path):
    for name, mesh in (("a", SQUAT), ("b", WALK)):
        path = tmp_path / f"{name}.ply"
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
    return tmp_path


def test_the_command_writes_what_is_asked_for(cli, files):
    words = ["a.ply", "b.ply", "output=out", "picture=false", "export=[dense,registered,morph]"]
    code, out, _ = cli(*words, program=main)
    assert code == 0 and "morph.glb" in out
    with np.load(files / "out" / "dense.npz") as dense:
        assert dense["corners"].shape == (1500, 3) and dense["points"].shape == (1500, 3)
    lines = (files / "out" / "dense.csv").read_text().splitlines()
    assert len(lines) == 1501 and lines[0].startswith("source,a,b,c,")
    mesh = trimesh.load(files / "out" / "registered.ply", process=False)
    assert mesh.faces.shape == TEMPLATE.faces.shape
    code, _, _ = cli(*words[:-1], program=main)
    assert code == 0 and not (files / "out" / "registered.ply").exists()  # of an earlier command


def test_an_export_that_needs_a_target_says_so(cli, files):
    code, out, err = cli("a.ply", "export=morph", program=main)
    assert code == 1 and "export=morph relates to the target; give target=" in out + err


def test_the_bundled_network_registers_a_body():
    opened = scan(SQUAT.vertices, SQUAT.faces, "a.ply")
    labelled = LabelledScan(opened, *Matcher.load(refine="zoomout").predict(opened))
    positions, _ = registered(labelled, TEMPLATE)
    off = np.linalg.norm(positions - SQUAT.vertices, axis=1) / SQUAT.size
    assert np.median(off) < 0.02
