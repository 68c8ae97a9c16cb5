"""The command `evaluate`: metrics, files, other data sets, rotations, and error messages."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from meshspiral.commands.evaluate import main
from meshspiral.data.cache import Cache
from meshspiral.data.datamodule import CorrespondenceData
from meshspiral.data.descriptors import Features
from meshspiral.data.descriptors.shot import Shot
from meshspiral.data.settings import ShotSettings
from meshspiral.data.shapes import DataError, Shape, ShapeSet, SurfacePoints
from meshspiral.evaluation import retest
from meshspiral.evaluation.distributions import Distributions
from meshspiral.evaluation.metrics import THRESHOLDS, at_vertices, point_errors
from meshspiral.evaluation.outcome import Outcome, Result, evenly, result_of, rotations
from meshspiral.evaluation.retest import config_on_data
from meshspiral.experiment.run_folder import BEST, CONFIG, ERRORS, METRICS, RunError
from meshspiral.experiment.schema import ConfigError
from meshspiral.geometry.barycentric import interpolate
from meshspiral.training.checkpoints import template_of
from tests.conftest import toy_shapes
from tests.helpers import composed, run
from tests.neighbourhoods.made import spiral

SEED = 3
REMESH = {"policy": "mixed", "vertices": 120, "copies": 1, "shared": None}
FOLDER = {
    "name": "folder",
    "template": "template.ply",
    "labels": "y",
    "train": ["a"],
    "val": ["b"],
    "test": ["c"],
}


@pytest.fixture(scope="module")
def trained(tmp_path_factory, toy_overrides):
    folder = tmp_path_factory.mktemp("trained")
    overrides = [*toy_overrides, "optim.epochs=20", "optim.lr=0.01", "metric=true", f"seed={SEED}"]
    return folder, run(folder, overrides)


@pytest.fixture
def moved(trained, tmp_path):
    """A copy of the run in another folder."""
    return Path(shutil.copytree(trained[0], tmp_path / "moved")), trained[1]


def test_evaluate_reproduces_the_metrics_of_a_run(cli, moved):
    folder, metrics = moved
    code, out, err = cli(f"run={folder}", "shapes=0", program=main)
    assert code == 0, err
    output = folder / "evaluation" / "folder"
    again = json.loads((output / METRICS).read_text())
    assert len(again) == 6
    assert again == pytest.approx({key: metrics[key] for key in again}, rel=1e-6)
    assert json.loads((folder / METRICS).read_text()) == metrics  # the run's own file is unchanged
    old, new = Outcome.load(folder / ERRORS), Outcome.load(output / ERRORS)
    np.testing.assert_array_equal(old.predicted, new.predicted)
    assert f"{100 * metrics['test/exact_match']:.2f} %" in out
    for kind, begin in {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}.items():
        assert (output / f"curve.{kind}").read_bytes().startswith(begin)
    assert not (output / "errors.png").exists()


def test_evaluate_reproduces_the_metrics_in_float64(cli, toy_overrides, tmp_path):
    metrics = run(tmp_path / "run", [*toy_overrides, "optim.epochs=1", "trainer.precision=64"])
    code, _, err = cli(f"run={tmp_path / 'run'}", "shapes=0", program=main)
    assert code == 0, err
    again = json.loads((tmp_path / "run/evaluation/folder" / METRICS).read_text())
    assert again == pytest.approx({key: metrics[key] for key in again}, rel=1e-6)


def test_errors_npz_holds_the_error_of_every_vertex(trained):
    folder, metrics = trained
    outcome = Outcome.load(folder / ERRORS)
    assert outcome.names == ["test_0", "test_1", "test_2"]
    assert outcome.first.tolist() == [0, 162, 324, 486]
    assert outcome.labels[outcome.mesh(outcome.names[1])].tolist() == list(range(162))
    exact = outcome.predicted == outcome.labels
    assert exact.mean() == pytest.approx(metrics["test/exact_match"])
    assert (outcome.errors[exact] == 0).all() and (outcome.errors[~exact] > 0).all()
    assert outcome.errors.mean() == pytest.approx(metrics["test/geodesic_error"])
    assert outcome.diameter * metrics["test/geodesic_error_diameter"] == pytest.approx(
        metrics["test/geodesic_error"]
    )


def test_another_data_set_with_the_same_template_can_be_tested(cli, moved, toy):
    folder, metrics = moved
    other = [
        "data=folder",
        f"data.root={toy}",
        "data.template=template.ply",
        "data.labels=identity",
        "data.train=[train/0.ply]",
        "data.val=[test/*.ply]",
        "data.test=[val/*.ply]",
    ]
    code, _, err = cli(f"run={folder}", *other, "shapes=0", program=main)
    assert code == 0, err
    [output] = (folder / "evaluation").iterdir()
    assert output.name.startswith("folder-")  # not the folder of its own test set
    again = json.loads((output / METRICS).read_text())
    assert again["test/exact_match"] == pytest.approx(metrics["val/exact_match"])
    assert again["test/geodesic_error"] == pytest.approx(metrics["val/geodesic_error"])
    assert Outcome.load(output / ERRORS).names != Outcome.load(folder / ERRORS).names


def test_each_rotation_uses_other_spirals(cli, moved):
    folder, metrics = moved
    code, out, err = cli(f"run={folder}", "rotations=4", "shapes=0", program=main)
    assert code == 0, err
    output = folder / "evaluation" / "folder"
    repeated = json.loads((output / METRICS).read_text())
    assert repeated["rotations/runs"] == 4
    assert 0 < repeated["rotations/unchanged"] < 1
    assert repeated["rotations/exact_match/spread"] > 0
    assert repeated["rotations/exact_match/mean"] == pytest.approx(
        metrics["test/exact_match"], abs=0.1
    )
    assert (output / "rotations.pdf").is_file()
    assert f"{100 * repeated['rotations/unchanged']:.2f} % of the vertices" in out


def test_rotations_pool_meshes_and_compare_runs():
    def mesh(*predicted):
        errors = np.array(predicted, dtype=float) / 10
        return Result(np.array(predicted), errors, errors)

    truth = [np.array([0, 0]), np.array([0, 0])]
    runs = [[mesh(0, 1), mesh(0, 0)], [mesh(0, 1), mesh(1, 0)], [mesh(0, 0), mesh(1, 0)]]
    found = rotations(iter(runs), truth)
    assert found.exact_match.tolist() == [0.75, 0.5, 0.75]
    np.testing.assert_allclose(found.geodesic_error, [0.025, 0.05, 0.025])
    assert found.unchanged == 0.5  # the first vertex of the first mesh, the second of the second
    assert found.curves.shape == (3, len(THRESHOLDS)) and found.curves[0, 0] == 0.75
    metrics = found.metrics()
    assert metrics["exact_match/least"] == 0.5 and metrics["exact_match/most"] == 0.75
    assert metrics["exact_match/mean"] == pytest.approx(2 / 3)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ([], "run= is missing: folder of a run"),
        (["run=nowhere"], "run=nowhere is not a folder"),
        (["run=empty"], "empty has no checkpoints/best.ckpt: it is no run"),
        (["run=begun"], "begun has no checkpoints/best.ckpt: no epoch has finished"),
        (["run=damaged"], "damaged/checkpoints/best.ckpt is damaged"),
        (["run=moved", "rotations=1"], "rotations must be 0 or at least 2, got 1"),
        (
            ["run=moved", "shapes=[nobody]"],
            "the test shapes (test_0, test_1, test_2), got nobody",
        ),
        (
            ["run=moved", "shapes=some"],
            "a number of test shapes, or a list of their names, got some",
        ),
        (["run=moved", "data=bodies"], "which has 162 vertices; got another template, of 1500"),
        (["run=moved", "+depth=1"], "unknown key depth"),
        (["run=moved", "accelerator=abacus"], "accelerator must be one of cpu, gpu, got abacus"),
    ],
)
def test_a_mistake_gives_a_one_line_error(cli, moved, tmp_path, arguments, message):
    (tmp_path / "empty").mkdir()
    (tmp_path / "begun").mkdir()
    shutil.copy(moved[0] / CONFIG, tmp_path / "begun")
    shutil.copytree(moved[0], tmp_path / "damaged")
    intact = (moved[0] / BEST).read_bytes()
    (tmp_path / "damaged" / BEST).write_bytes(intact[: len(intact) // 2])
    code, out, err = cli(*arguments, program=main)
    assert code == 1
    assert message in (out + err).strip().splitlines()[-1]
    assert "Traceback" not in out + err


def test_a_moved_data_set_is_found_with_data_root(cli, toy, toy_overrides, tmp_path):
    old_root = Path(shutil.copytree(toy, tmp_path / "here"))
    overrides = [o.replace(str(toy), str(old_root)) for o in toy_overrides]
    run(tmp_path / "run", [*overrides, "optim.epochs=1"])
    new_root = old_root.rename(tmp_path / "there")
    code, out, _ = cli("run=run", "shapes=0", program=main)
    last = out.strip().splitlines()[-1]
    assert code == 1 and str(old_root) in last and last.endswith("has moved, add data.root=")
    code, _, err = cli("run=run", "shapes=0", f"data.root={new_root}", program=main)
    assert code == 0, err


def test_rotations_need_random_neighbourhoods(cli, toy_overrides, tmp_path):
    run(
        tmp_path / "run",
        [*toy_overrides, "optim.epochs=1", "model=gcnn3", "neighbourhood.radius=0.2"],
    )
    code, out, err = cli("run=run", "rotations=2", program=main)
    message = "rotations must be 0 for gcnn3, whose patches are not random, got 2"
    assert code == 1 and message in out + err


def test_a_damaged_errors_npz_is_rejected(trained, tmp_path):
    intact = (trained[0] / ERRORS).read_bytes()
    damaged = {"half": intact[: len(intact) // 2], "text": b"no", "empty": b""}
    rng = np.random.default_rng(0)
    for i in rng.integers(len(intact), size=60):
        damaged[f"byte_{i}"] = intact[:i] + bytes([intact[i] ^ 255]) + intact[i + 1 :]
    rejected = 0
    for name, content in damaged.items():
        (tmp_path / name).write_bytes(content)
        try:
            outcome = Outcome.load(tmp_path / name)  # a byte that is never read does no harm
            assert len(outcome.predicted) == outcome.first[-1]
        except RunError as error:
            assert f"{name} is damaged" in str(error)
            rejected += 1
    assert rejected > 40
    with pytest.raises(RunError, match="does not exist"):
        Outcome.load(tmp_path / "nowhere")


def test_arrays_of_different_lengths_are_rejected(trained, tmp_path):
    with np.load(trained[0] / ERRORS) as file:
        arrays = dict(file)
    np.savez(tmp_path / "short.npz", **arrays | {"errors": arrays["errors"][:-1]})
    with pytest.raises(RunError, match="different lengths"):
        Outcome.load(tmp_path / "short.npz")


def test_plots_of_an_earlier_evaluation_are_removed(cli, moved):
    folder, _ = moved
    assert cli(f"run={folder}", "rotations=2", "shapes=0", program=main)[0] == 0
    assert (folder / "evaluation/folder/rotations.png").is_file()
    assert cli(f"run={folder}", "shapes=0", program=main)[0] == 0
    assert not (folder / "evaluation/folder/rotations.png").exists()


@pytest.mark.parametrize(
    "requested, expected",
    [
        (
            {"shot": {"bins": 8}},
            {"root": "here", "labels": "x", "shot": {"radius": 0.3, "bins": 8, "by_area": False}},
        ),
        ({"root": None, "workers": 2}, {"root": "here", "labels": "x", "workers": 2}),
        (
            {**FOLDER, "root": "there"},
            {"root": "there", "labels": "y", "remesh": None, "workers": 1},
        ),
        (
            {**FOLDER, "root": "there", "remesh": REMESH, "shuffle_vertices": False},
            {"root": "there", "labels": "y", "remesh": REMESH, "shuffle_vertices": False},
        ),
    ],
)
def test_requested_data_settings_replace_those_of_the_run(toy_overrides, requested, expected):
    own = ["data.root=here", "data.labels=x", "data.shuffle_vertices=true"]
    own += [
        f"+data.remesh.{key}={'null' if value is None else value}" for key, value in REMESH.items()
    ]
    trained = composed([*toy_overrides, *own])
    config = config_on_data(trained, requested)
    data = config.data.model_dump()
    for key, value in expected.items():
        assert data[key] == value
    assert data["shot"]["radius"] == 0.3
    assert data["shuffle_vertices"] == requested.get("shuffle_vertices", True)
    assert data["remesh"] == (requested.get("remesh") if "name" in requested else REMESH)
    for group in ("model", "neighbourhood", "optim", "trainer", "seed"):
        assert getattr(config, group) == getattr(trained, group)


def test_a_run_on_fresh_shapes_is_tested_on_a_data_set_without_any(toy_overrides):
    trained = composed([*toy_overrides, "data.fresh=true"])
    for requested in ({}, {"name": "bodies", "vertices": 1500}):
        assert not config_on_data(trained, requested).data.fresh


@pytest.mark.parametrize(
    "requested, message",
    [
        ({"name": "folder", "root": None}, "data.root= is missing"),
        ({"name": "bodies", "vertices": 1500, "train": []}, "unknown key data.train"),
        ({"name": "nobody"}, "data.name must be one of .*bodies.*, got nobody"),
        ({"shot": {"bins": 0}}, "data.shot.bins must be at least 1, got 0"),
    ],
)
def test_requested_data_settings_are_checked(toy_overrides, requested, message):
    with pytest.raises(ConfigError, match=message):
        config_on_data(composed(toy_overrides), requested)


# ---------------------------------------------------------- labels that are points within faces


class LabelledWithPoints(ShapeSet):
    """The template, labelled with points: each lies in a face, near the labelled vertex."""

    def __init__(self):
        self.template = toy_shapes()["template.ply"]
        self.names = {"train": ["a"], "val": ["b"], "test": ["c"]}

    def load(self, name):
        size = len(self.template.vertices)
        corners = np.stack(
            [self.template.faces[(self.template.faces == v).any(1)][0] for v in range(size)]
        )
        weights = np.where(corners == np.arange(size)[:, None], 0.8, 0.1)
        return Shape(self.template, np.arange(size), size, SurfacePoints(corners, weights))


def point_data(tmp_path, shuffled=False):
    features = Features((Shot(ShotSettings(radius=0.3, bins=4, by_area=False)),), 0.3)
    cache, options = Cache(tmp_path), {"workers": 1, "shuffle_vertices": shuffled}
    return CorrespondenceData(LabelledWithPoints(), features, spiral(8), cache, **options)


@pytest.mark.parametrize("shuffled", [False, True])
def test_errors_are_measured_to_the_point_and_to_the_labelled_vertex(tmp_path, shuffled):
    data = point_data(tmp_path, shuffled)
    data.prepare(["test"])
    item = data.datasets["test"][0]
    assert (item["labels"] != torch.arange(162)).any() == shuffled
    labels, positions = item["labels"].numpy(), data.reference.place
    result = result_of(labels, item, data.reference)
    assert (result.label_errors == 0).all()
    point = np.einsum("vk,vkx->vx", item["weights"], positions[item["corners"]])
    np.testing.assert_allclose(result.errors, np.linalg.norm(point - positions[labels], axis=1))
    outcome = Outcome.of(["c"], [item], {0: result}, data.reference.diameter)
    metrics, curve = outcome.metrics()
    assert metrics["geodesic_error"] > 0 == metrics["geodesic_error_to_label"]
    assert metrics["exact_match"] == 1 and curve[0] == 0


def test_the_distance_to_a_point_is_interpolated_from_those_to_its_corners(tmp_path):
    data = point_data(tmp_path)
    reference, template = data.reference, data.shapes.template
    corners = template.faces[:50]
    predicted = np.full(50, 160)
    at_predicted = (corners == 160).any(axis=1)
    to_corners = np.stack([reference(corner, predicted) for corner in corners.T], axis=1)
    centres = SurfacePoints(corners, np.full((50, 3), 1 / 3))
    error = point_errors(at_vertices(predicted), centres, reference, reference.place)
    np.testing.assert_allclose(error[~at_predicted], to_corners[~at_predicted].mean(axis=1))
    first = at_vertices(corners[:, 0])
    at_corner = point_errors(at_vertices(predicted), first, reference, reference.place)
    np.testing.assert_allclose(at_corner[~at_predicted], to_corners[~at_predicted, 0], rtol=1e-6)


def test_points_are_measured_from_both_sides():
    """As predictions and as true points; straight where their faces touch."""
    template, rng = LabelledWithPoints().template, np.random.default_rng(0)
    faces, place = template.faces, template.vertices

    def distances(sources, targets):
        return np.linalg.norm(place[sources] - place[targets], axis=1)

    some, others = (
        SurfacePoints(faces[rng.permutation(200)], rng.dirichlet(np.ones(3), 200)) for _ in range(2)
    )
    forth = point_errors(some, others, distances, place)
    np.testing.assert_allclose(forth, point_errors(others, some, distances, place))
    touch = np.array([bool({*a} & {*b}) for a, b in zip(some.corners, others.corners, strict=True)])
    ends = (interpolate(place, *points) for points in (some, others))
    straight = np.linalg.norm(next(ends) - next(ends), axis=1)
    assert 0 < touch.sum() < 200
    np.testing.assert_allclose(forth[touch], straight[touch])
    assert (forth[~touch] > straight[~touch]).all()
    assert (point_errors(some, some, distances, place) == 0).all()


def test_a_prediction_shared_by_three_vertices_is_a_point_within_their_face(tmp_path, monkeypatch):
    monkeypatch.setattr(retest, "SPREAD", 0.2)  # of this coarse template, all corners of a face
    data = point_data(tmp_path)
    data.prepare(["test"])
    item, distances = data.datasets["test"][0], data.reference
    corners, weights = item["corners"].numpy(), item["weights"].numpy()
    probabilities = np.full((162, 162), 1e-12)
    np.put_along_axis(probabilities, corners, weights, axis=1)
    found = Distributions(
        torch.from_numpy(np.log(probabilities)),
        torch.eye(162, dtype=torch.float64),
        torch.zeros(162, dtype=torch.float64),
        np.arange(162),
    )
    labels = item["labels"].numpy()
    outcome = Outcome.of(["c"], [item], {0: result_of(labels, item, distances)}, distances.diameter)
    errors = retest.evaluate_points(lambda batch, purpose: found, data, outcome)
    assert errors.max() < 1e-4 < outcome.errors.min()


def test_points_are_evaluated_beside_vertices(cli, moved):
    folder, metrics = moved
    code, out, err = cli(f"run={folder}", "points=true", "shapes=0", program=main)
    assert code == 0, err
    found = json.loads((folder / "evaluation" / "folder" / METRICS).read_text())
    assert found["test/exact_match"] == pytest.approx(metrics["test/exact_match"])
    assert found["points/geodesic_error"] > 0 and "points/exact_match" not in found
    assert f"{found['points/geodesic_error']:.4f}" in out.split("Points within faces")[1]


def test_points_must_be_on_the_template():
    mesh = toy_shapes()["template.ply"]
    labels, weights = np.arange(162), np.ones((162, 3)) / 3
    for corners in (np.full((162, 3), 162), np.full((162, 3), -1)):
        with pytest.raises(DataError, match=r"162 points outside 0\.\.161"):
            Shape(mesh, labels, 162, SurfacePoints(corners, weights))
    with pytest.raises(DataError, match="162 vertices but points"):
        Shape(mesh, labels, 162, SurfacePoints(np.zeros((9, 3), int), weights))


# ------------------------------------------------------------------ rendered shapes, checkpoints


def test_rendered_shapes_are_chosen_evenly():
    names = list("abcdefghij")
    assert evenly(names, 4) == ["a", "d", "g", "j"]
    assert evenly(names, 100) == names and evenly(names, 1) == ["a"]


def test_a_checkpoint_holds_the_template_and_no_optimizer_state(trained):
    saved = torch.load(trained[0] / BEST, weights_only=True)
    faces = toy_shapes()["template.ply"].faces
    np.testing.assert_array_equal(template_of(saved).faces, faces)
    assert saved["resolution"] == 162 and "optimizer_states" not in saved


def test_votes_predict_from_several_draws_in_a_folder_of_their_own(cli, moved):
    folder, metrics = moved
    code, out, err = cli(f"run={folder}", "votes=5", "shapes=0", program=main)
    assert code == 0, err
    voted = json.loads((folder / "evaluation" / "folder-votes5" / METRICS).read_text())
    assert voted["test/exact_match"] != metrics["test/exact_match"]
    assert voted["test/exact_match"] == pytest.approx(metrics["test/exact_match"], abs=0.1)
    assert "per mesh, 5 votes" in out


def test_other_settings_of_the_data_get_a_folder_of_their_own(cli, moved):
    folder, _ = moved
    cli(f"run={folder}", "shapes=0", program=main)
    before = (folder / "evaluation" / "folder" / METRICS).read_text()
    code, _, err = cli(f"run={folder}", "shapes=0", "+data.shot.radius=0.1", program=main)
    assert code == 0, err
    assert (folder / "evaluation" / "folder" / METRICS).read_text() == before
    assert len(list(folder.glob("evaluation/folder-*/metrics.json"))) >= 1


@pytest.mark.parametrize("override", ["votes=2", "rotations=2"])
def test_draws_that_are_not_random_cannot_vote(cli, moved, tmp_path, override):
    folder = tmp_path / "frame"
    shutil.copytree(moved[0], folder)
    saved = torch.load(folder / BEST, weights_only=True)
    saved["hyper_parameters"]["config"]["neighbourhood"] |= {"start": "frame"}
    torch.save(saved, folder / BEST)
    code, out, _ = cli(f"run={folder}", override, "shapes=0", program=main)
    key, least = override.split("=")[0], 1 if "votes" in override else 0
    assert code == 1 and f"{key} must be {least} for fcs, whose spirals are not random" in out
