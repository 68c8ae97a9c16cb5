"""`Matcher`: labels and maps, their invariances, and labels or one message for damaged meshes."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import meshspiral
from meshspiral import Matcher, Mesh, open_scan, scan
from meshspiral.data.datasets.bodies import Bodies
from meshspiral.experiment.run_folder import BEST, RunError
from meshspiral.geometry.faces import directed_edges
from meshspiral.geometry.mesh import MeshError
from meshspiral.matching.matcher import FACTORS, Labels, nearest_vertices, normalize
from tests.conftest import toy_shapes
from tests.damage import damaged_file
from tests.helpers import clone_environment

TOYS = toy_shapes()
SOURCE, TARGET, TEMPLATE = TOYS["test/0.ply"], TOYS["test/1.ply"], TOYS["template.ply"]


@pytest.fixture(scope="module")
def matcher(trained):
    return Matcher.load(trained)


def scan_of(mesh, **changes):
    arrays = {"vertices": mesh.vertices, "faces": mesh.faces} | changes
    return scan(arrays["vertices"], arrays["faces"], "a")


# ------------------------------------------------------------------------- names of the package


def test_importing_the_package_loads_no_library():
    check = "import sys, meshspiral; print({'numpy', 'torch', 'trimesh'} & set(sys.modules))"
    command = [sys.executable, "-c", check]
    done = subprocess.run(command, env=clone_environment(), capture_output=True, text=True)
    assert done.stdout == "set()\n", done.stderr


def test_the_package_offers_its_names_and_no_others():
    assert {"Matcher", "Mesh", "open_scan", "scan"} == set(meshspiral.__all__)
    assert all(hasattr(meshspiral, name) for name in meshspiral.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'matcher'"):
        meshspiral.matcher  # noqa: B018  the access is what is tested


# ------------------------------------------------------------------------------ nearest vertices


def labels(positions, confidence):
    """Labels at points on the x axis; NaN for a vertex without a label."""
    points = np.array(positions, dtype=float).reshape(-1, 1) * [1.0, 0.0, 0.0]
    template = np.where(np.isnan(points[:, 0]), -1, 7).astype(np.int32)
    return Labels(template, points, np.array(confidence, dtype=np.float32))


def test_the_map_goes_to_the_nearest_point_on_the_template():
    source = labels([0.1, 4.9, np.nan], [1, 1, 0])
    target = labels([5.0, 0.0, np.nan, 1], [1, 1, 0, 1])
    assert nearest_vertices(source, target).tolist() == [1, 0, -1]


def test_of_several_vertices_at_one_point_the_most_confident_is_chosen():
    target = labels([2, 2, 2], [0.1, 0.9, 0.5])
    assert nearest_vertices(labels([2], [1]), target).tolist() == [1]


def test_without_any_label_there_is_no_match():
    known, unknown = labels([1, 2], [1, 1]), labels([np.nan, np.nan], [0, 0])
    assert nearest_vertices(known, unknown).tolist() == [-1, -1]
    assert nearest_vertices(unknown, known).tolist() == [-1, -1]


# --------------------------------------------------------------------------------------- labels


def test_the_bundled_network_labels_bodies():
    shapes = Bodies(1500)
    mesh = shapes.load("s9_squat").mesh
    found = Matcher.load().label(scan_of(mesh))
    assert (found.template == np.arange(1500)).mean() > 0.5  # the bodies are registered


def test_a_trained_network_finds_most_of_the_map(matcher):
    match = matcher.match(scan_of(SOURCE), scan_of(TARGET))
    errors = np.linalg.norm(TARGET.vertices[match.target] - TARGET.vertices, axis=1)
    assert np.median(errors) < 0.15 * np.sqrt(TARGET.area)
    assert (match.source_labels.confidence > 0).all()
    assert (match.source_labels.confidence <= 1).all()


def test_unit_pose_and_vertex_order_do_not_matter(matcher):
    found = matcher.label(scan_of(SOURCE))
    larger = matcher.label(scan_of(SOURCE, vertices=1024 * SOURCE.vertices))
    np.testing.assert_array_equal(larger.template, found.template)
    rotation = trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.6, 0.3]))[:3, :3]
    moved = SOURCE.vertices @ rotation.T * 1000 + [1e4, 0, 5]
    moved = matcher.label(scan_of(SOURCE, vertices=moved))
    # not all: the polar grids of patches begin in other directions
    assert (moved.template == found.template).mean() > 0.8
    order = np.random.default_rng(0).permutation(len(SOURCE.vertices))
    renumbered = matcher.label(scan_of(SOURCE.renumbered(order)))
    assert (renumbered.template == found.template[order]).mean() > 0.8


def test_a_mesh_of_another_density_is_resampled(trained):
    dense = trimesh.Trimesh(SOURCE.vertices, SOURCE.faces).subdivide().subdivide()
    finer = scan(np.asarray(dense.vertices), np.asarray(dense.faces), "a")
    points = Matcher.load(trained).label(scan_of(SOURCE)).points
    distances = np.linalg.norm(dense.vertices[:, None] - SOURCE.vertices, axis=2)
    nearest = distances.argmin(axis=1)

    def deviation(**options):
        found = Matcher.load(trained, **options).label(finer)
        return np.median(np.linalg.norm(found.points - points[nearest], axis=1))

    assert deviation() == deviation(resampled=True) < deviation(resampled=False)


def test_smoothing_lowers_the_error(trained):
    def error(**options):
        found = Matcher.load(trained, **options).label(scan_of(SOURCE))
        return np.linalg.norm(found.points - TEMPLATE.vertices, axis=1).mean()

    assert error(smooth=True) < error()


def test_smoothing_does_not_depend_on_the_templates_unit(trained):
    found = []
    for scale in (1, 1000):
        matcher = Matcher.load(trained, smooth=True)
        matcher.template = Mesh(scale * matcher.template.vertices, matcher.template.faces)
        found.append(matcher.label(scan_of(SOURCE)).template)
    np.testing.assert_array_equal(*found)


def test_confidence_after_smoothing_is_that_of_the_refined_label(trained):
    raw, smooth = (Matcher.load(trained, smooth=s).label(scan_of(SOURCE)) for s in (False, True))
    same = raw.template == smooth.template
    assert 0 < same.mean() < 1
    np.testing.assert_allclose(smooth.confidence[same], raw.confidence[same], rtol=1e-4)
    assert (smooth.confidence[~same] <= raw.confidence[~same]).all()


def test_an_open_surface_is_refined_by_its_neighbours(trained):
    half = scan_of(SOURCE, faces=SOURCE.faces[: len(SOURCE.faces) // 2])
    raw, refined = (
        Matcher.load(trained, refine=refine, ensemble=False).label(half) for refine in (None, "crf")
    )
    a, b = directed_edges(SOURCE.faces[: len(SOURCE.faces) // 2]).T

    def apart(labels: np.ndarray) -> np.ndarray:
        return np.linalg.norm(TEMPLATE.vertices[labels[a]] - TEMPLATE.vertices[labels[b]], axis=1)

    assert (refined.template >= 0).sum() == len(half.mesh.vertices)  # those on a face
    assert apart(refined.template).mean() < 0.9 * apart(raw.template).mean()


# ------------------------------------------------------------------------------------------ size


def test_with_a_height_radii_are_in_proportion_to_it(trained):
    matcher = Matcher.load(trained)
    tall = np.ptp(matcher.template.vertices[:, "xyz".index(matcher.up)])
    for factor in (1.0, 1.3, 30.0):
        matcher = Matcher.load(trained, height=factor * tall)
        sized = matcher._sized(upper_half(), lambda stage: None)
        assert sized.size == pytest.approx(factor * TEMPLATE.size)


def upper_half() -> Mesh:
    keep = SOURCE.vertices[:, 2] > np.median(SOURCE.vertices[:, 2])
    return SOURCE.with_faces(SOURCE.faces[keep[SOURCE.faces].all(axis=1)])


def test_with_a_scale_radii_are_those_of_the_template(trained):
    size = TEMPLATE.size
    for scale in (1.0, 0.1):
        sized = Matcher.load(trained, scale=scale)._sized(upper_half(), lambda stage: None)
        assert sized.size == pytest.approx(size / scale)
    sized = Matcher.load(trained, scale=size / SOURCE.size)._sized(SOURCE, lambda stage: None)
    np.testing.assert_allclose(normalize(sized).vertices, normalize(SOURCE).vertices)


@pytest.mark.parametrize("options", [{"scale": 0.001}, {"height": 1700.0}])
def test_a_mesh_in_another_unit_than_the_given_one_is_refused(trained, options):
    matcher = Matcher.load(trained, **options)
    matcher.label(scan(1000 * SOURCE.vertices, SOURCE.faces, "millimetres"))
    with pytest.raises(MeshError, match=r"metres: .* is this mesh in another unit"):
        matcher.label(scan(SOURCE.vertices, SOURCE.faces, "metres"))


def test_the_size_of_an_open_surface_is_that_of_which_the_network_is_surest(matcher, monkeypatch):
    half, stages, asked = upper_half(), [], []

    def sureness(mesh):
        asked.append(np.sqrt(1 / mesh.area))  # the size of the whole over that of the part
        return np.exp(-((asked[-1] - 1.44) ** 2))

    monkeypatch.setattr(matcher, "_sureness", sureness)
    sized = matcher._sized(half, stages.append)
    assert sized.size / half.size == pytest.approx(1.45) and stages == ["size"]
    np.testing.assert_allclose(asked, FACTORS, rtol=1e-6)


def test_probable_and_smooth_labels_are_sure(matcher, monkeypatch):
    mesh = matcher.template  # 162 vertices
    smooth, torn = np.arange(162), np.random.default_rng(0).permutation(162)
    monkeypatch.setattr(matcher, "_embed", lambda mesh: None)

    def sureness(labels, probability):
        found = SimpleNamespace(
            classes=torch.as_tensor(labels), probability=torch.full((162,), probability)
        )
        monkeypatch.setattr(matcher._predictor, "predict", lambda embedding: found)
        return matcher._sureness(mesh)

    assert sureness(smooth, 0.75) > sureness(smooth, 0.5) > sureness(torn, 0.5)
    lengths = np.linalg.norm(
        mesh.vertices[mesh.faces] - mesh.vertices[mesh.faces[:, [1, 2, 0]]], axis=2
    )
    share = (lengths > 0.15 * mesh.size).mean()
    assert sureness(smooth, 0.5) == pytest.approx(0.5 - 2 * share)


def test_a_surface_without_large_holes_has_its_own_size(matcher):
    for mesh in (SOURCE, SOURCE.with_faces(SOURCE.faces[1:])):
        assert matcher._sized(mesh, pytest.fail) is mesh


def test_an_isolated_vertex_gets_no_label_and_changes_no_other(matcher):
    vertices = np.concatenate([[[1e30, 0, 0]], SOURCE.vertices])
    found = matcher.label(scan(vertices, SOURCE.faces + 1, "a"))
    np.testing.assert_array_equal(found.template[1:], matcher.label(scan_of(SOURCE)).template)
    assert found.template[0] == -1 and found.confidence[0] == 0 and np.isnan(found.points[0]).all()


# ---------------------------------------------------------------------------------- checkpoints


def test_the_checkpoint_alone_is_enough(trained, matcher, tmp_path):
    checkpoint = tmp_path / "run" / BEST
    checkpoint.parent.mkdir(parents=True)
    checkpoint.write_bytes((trained / BEST).read_bytes())
    np.testing.assert_array_equal(
        Matcher.load(tmp_path / "run").label(scan_of(SOURCE)).template,
        matcher.label(scan_of(SOURCE)).template,
    )


def test_a_malicious_checkpoint_runs_nothing(trained, tmp_path):
    class Malicious:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "owned"),)

    checkpoint = tmp_path / "run" / BEST
    checkpoint.parent.mkdir(parents=True)
    saved = torch.load(trained / BEST, weights_only=True)
    torch.save({**saved, "extra": Malicious()}, checkpoint)
    with pytest.raises(RunError, match="contains more than weights and was not opened"):
        Matcher.load(tmp_path / "run")
    assert not (tmp_path / "owned").exists()
    checkpoint.write_bytes((trained / BEST).read_bytes()[:-100])
    with pytest.raises(RunError, match="damaged"):
        Matcher.load(tmp_path / "run")


# ------------------------------------------------------------------------------- damaged meshes


@pytest.fixture(scope="module")
def matchers(trained):
    """One that neither resamples nor smooths, one that resamples, and one that smooths."""
    options = ({"resampled": False}, {"resampled": True}, {"resampled": False, "smooth": True})
    return [Matcher.load(trained, **each) for each in options]


@given(seed=st.integers(0, 2**32), repair=st.booleans(), which=st.integers(0, 2))
@settings(
    max_examples=100,
    deadline=10_000,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
def test_a_damaged_file_gives_labels_or_one_message(matchers, tmp_path, seed, repair, which):
    suffix, data = damaged_file(SOURCE, seed)
    path = tmp_path / f"mesh{suffix}"
    path.write_bytes(data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            found = open_scan(path, repair)
            labels = matchers[which].label(found)
    except MeshError as error:
        assert str(path) in str(error) and "\n" not in str(error) and len(str(error)) < 600
        return
    known = found.vertex_of >= 0
    assert len(labels.template) == len(found.vertices)
    np.testing.assert_array_equal(labels.template >= 0, known)
    assert (labels.template < len(TEMPLATE.vertices)).all()
    assert np.isfinite(labels.points[known]).all() and np.isfinite(labels.confidence).all()
    low, high = TEMPLATE.vertices.min(axis=0) - 1e-6, TEMPLATE.vertices.max(axis=0) + 1e-6
    assert ((labels.points[known] >= low) & (labels.points[known] <= high)).all()
    assert ((labels.confidence >= 0) & (labels.confidence <= 1)).all()


@pytest.mark.parametrize(
    "options, message",
    [
        ({"refine": "zoom"}, "refine must be one of .*'crf', 'zoomout'.*, got 'zoom'"),
        ({"scale": 1.0, "height": 1.7}, "give scale or height, not both"),
        ({"height": -1.0}, "height must be positive and finite, got -1.0"),
        ({"scale": 0.0}, "scale must be positive and finite, got 0.0"),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Matcher.load(**options)
