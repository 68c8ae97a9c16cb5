"""Evaluation from a run folder alone: the same figures again, files, rotations, clear messages."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from omegaconf import OmegaConf

from meshspiral.commands.evaluate import main, merged
from meshspiral.data.cache import Store
from meshspiral.data.datamodule import CorrespondenceData
from meshspiral.data.preprocessing import Recipe
from meshspiral.data.shapes import DataError, Shape, ShapeSet, SurfacePoints
from meshspiral.evaluation.metrics import THRESHOLDS, point_errors
from meshspiral.evaluation.outcome import ERRORS, Outcome, Result, evenly, result_of, rotations
from meshspiral.experiment.runs import BEST, METRICS, RunError
from meshspiral.geometry.mesh import Mesh
from meshspiral.training.predictor import template_of
from meshspiral.viz.plots import (
    all_curves_figure,
    curve_figure,
    encoded,
    error_colors,
    sketch_figure,
)
from meshspiral.viz.render import Row, render
from tests.commands.test_train import composed, run
from tests.conftest import toy_shapes
from tests.experiment.test_cli import cli  # noqa: F401
from tests.meshes import lattice

SEED = 3


@pytest.fixture(scope="module")
def trained(tmp_path_factory, toy_overrides):
    folder = tmp_path_factory.mktemp("trained")
    overrides = [*toy_overrides, "optim.epochs=20", "optim.lr=0.01", "metric=true", f"seed={SEED}"]
    return folder, run(folder, overrides)


@pytest.fixture
def moved(trained, tmp_path):
    """A copy of the run, elsewhere."""
    return Path(shutil.copytree(trained[0], tmp_path / "moved")), trained[1]


def test_a_run_folder_gives_its_figures_again(cli, moved):  # noqa: F811
    folder, metrics = moved
    code, out, err = cli(f"run={folder}", "shapes=0", program=main)
    assert code == 0, err
    written = folder / "evaluation" / "folder"
    again = json.loads((written / METRICS).read_text())
    assert len(again) == 6
    assert again == pytest.approx({key: metrics[key] for key in again}, rel=1e-6)
    assert json.loads((folder / METRICS).read_text()) == metrics  # the run's own file stays
    kept, new = Outcome.load(folder / ERRORS), Outcome.load(written / ERRORS)
    np.testing.assert_array_equal(kept.predicted, new.predicted)
    assert f"{100 * metrics['test/exact_match']:.2f} %" in out
    for kind, begin in {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}.items():
        assert (written / f"curve.{kind}").read_bytes().startswith(begin)
    assert not (written / "errors.png").exists()


@pytest.mark.parametrize(
    "overrides",
    [["trainer.precision=64"], ["model=lstm"], ["model=gcnn3", "model.patch.radius=0.2"]],
    ids=lambda overrides: overrides[0],
)
def test_every_network_gives_its_figures_again(cli, toy_overrides, tmp_path, overrides):  # noqa: F811
    metrics = run(tmp_path / "run", [*toy_overrides, "optim.epochs=1", *overrides])
    code, _, err = cli(f"run={tmp_path / 'run'}", "shapes=0", program=main)
    assert code == 0, err
    again = json.loads((tmp_path / "run/evaluation/folder" / METRICS).read_text())
    assert again == pytest.approx({key: metrics[key] for key in again}, rel=1e-6)


def test_errors_npz_holds_each_vertex(trained):
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


def test_another_data_set_with_the_same_template_can_be_tested(cli, moved, toy):  # noqa: F811
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
    [written] = (folder / "evaluation").iterdir()
    assert written.name.startswith("folder-")  # not where its own test set would go
    again = json.loads((written / METRICS).read_text())
    assert again["test/exact_match"] == pytest.approx(metrics["val/exact_match"])
    assert again["test/geodesic_error"] == pytest.approx(metrics["val/geodesic_error"])
    assert Outcome.load(written / ERRORS).names != Outcome.load(folder / ERRORS).names


def test_rotations_draw_other_spirals_each_time(cli, moved):  # noqa: F811
    folder, metrics = moved
    code, out, err = cli(f"run={folder}", "rotations=4", "shapes=0", program=main)
    assert code == 0, err
    written = folder / "evaluation" / "folder"
    figures = json.loads((written / METRICS).read_text())
    assert figures["rotations/runs"] == 4
    assert 0 < figures["rotations/unchanged"] < 1
    assert figures["rotations/exact_match/spread"] > 0
    assert figures["rotations/exact_match/mean"] == pytest.approx(
        metrics["test/exact_match"], abs=0.1
    )
    assert (written / "rotations.pdf").is_file()
    assert f"{100 * figures['rotations/unchanged']:.2f} % of the vertices" in out


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
    figures = found.figures()
    assert figures["exact_match/least"] == 0.5 and figures["exact_match/most"] == 0.75
    assert figures["exact_match/mean"] == pytest.approx(2 / 3)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ([], "run= is missing: the folder of a run"),
        (["run=nowhere"], "run=nowhere: is not a folder"),
        (["run=empty"], "empty holds no checkpoints/best.ckpt: it is no run"),
        (["run=begun"], "begun holds no checkpoints/best.ckpt: it is no finished epoch"),
        (["run=damaged"], "damaged/checkpoints/best.ckpt is damaged"),
        (["run=moved", "rotations=1"], "rotations must be 0 or at least 2, to compare; got 1"),
        (["run=moved", "shapes=[nobody]"], "shapes: nobody is no test shape; there are: "),
        (["run=moved", "shapes=some"], "shapes must be a number of test shapes, or a list"),
        (["run=moved", "data=bodies"], "the 1500 vertices of another template than the one of 162"),
        (["run=moved", "+depth=1"], "unknown key depth"),
        (["run=moved", "accelerator=abacus"], "accelerator must be one of cpu, gpu; got abacus"),
    ],
)
def test_a_mistake_is_one_clear_line(cli, moved, tmp_path, arguments, message):  # noqa: F811
    (tmp_path / "empty").mkdir()
    (tmp_path / "begun").mkdir()
    shutil.copy(moved[0] / "config.yaml", tmp_path / "begun")
    shutil.copytree(moved[0], tmp_path / "damaged")
    whole = (moved[0] / BEST).read_bytes()
    (tmp_path / "damaged" / BEST).write_bytes(whole[: len(whole) // 2])
    code, out, err = cli(*arguments, program=main)
    assert code == 1
    assert message in (out + err).strip().splitlines()[-1]
    assert "Traceback" not in out + err


def test_a_data_set_that_moved_can_be_named(cli, toy, toy_overrides, tmp_path):  # noqa: F811
    here = Path(shutil.copytree(toy, tmp_path / "here"))
    overrides = [o.replace(str(toy), str(here)) for o in toy_overrides]
    run(tmp_path / "run", [*overrides, "optim.epochs=1"])
    there = here.rename(tmp_path / "there")
    code, out, _ = cli("run=run", "shapes=0", program=main)
    last = out.strip().splitlines()[-1]
    assert code == 1 and str(here) in last and last.endswith("has moved: data.root=")
    code, _, err = cli("run=run", "shapes=0", f"data.root={there}", program=main)
    assert code == 0, err


def test_rotations_are_for_spirals(cli, toy_overrides, tmp_path):  # noqa: F811
    run(
        tmp_path / "run",
        [*toy_overrides, "optim.epochs=1", "model=gcnn3", "model.patch.radius=0.2"],
    )
    code, out, err = cli("run=run", "rotations=2", program=main)
    assert code == 1 and "rotations= is for networks on spirals; gcnn3 has none" in out + err


def test_a_damaged_errors_npz_is_one_clear_line(trained, tmp_path):
    whole = (trained[0] / ERRORS).read_bytes()
    damaged = {"half": whole[: len(whole) // 2], "text": b"no", "empty": b""}
    rng = np.random.default_rng(0)
    for place in rng.integers(len(whole), size=60):
        damaged[f"byte_{place}"] = whole[:place] + bytes([whole[place] ^ 255]) + whole[place + 1 :]
    refused = 0
    for name, content in damaged.items():
        (tmp_path / name).write_bytes(content)
        try:
            outcome = Outcome.load(tmp_path / name)  # a byte that nobody reads does no harm
            assert len(outcome.predicted) == outcome.first[-1]
        except RunError as error:
            assert f"{name} is damaged" in str(error)
            refused += 1
    assert refused > 40
    with pytest.raises(RunError, match="is not there"):
        Outcome.load(tmp_path / "nowhere")


def test_arrays_of_different_lengths_are_no_outcome(trained, tmp_path):
    with np.load(trained[0] / ERRORS) as file:
        arrays = dict(file)
    np.savez(tmp_path / "short.npz", **arrays | {"errors": arrays["errors"][:-1]})
    with pytest.raises(RunError, match="different lengths"):
        Outcome.load(tmp_path / "short.npz")


def test_figures_of_another_evaluation_do_not_stay(cli, moved):  # noqa: F811
    folder, _ = moved
    assert cli(f"run={folder}", "rotations=2", "shapes=0", program=main)[0] == 0
    assert (folder / "evaluation/folder/rotations.png").is_file()
    assert cli(f"run={folder}", "shapes=0", program=main)[0] == 0
    assert not (folder / "evaluation/folder/rotations.png").exists()


@pytest.mark.parametrize(
    "asked, kept",
    [
        (
            {"shot": {"bins": 8}},
            {"root": "here", "labels": "x", "shot": {"radius": 0.3, "bins": 8}},
        ),
        ({"root": None, "workers": 2}, {"root": "here", "labels": "x", "workers": 2}),
        ({"name": "folder", "root": "there", "labels": None}, {"root": "there", "labels": None}),
    ],
)
def test_what_is_asked_of_the_data_wins_over_the_run(toy_overrides, asked, kept):
    trained = OmegaConf.to_container(composed(toy_overrides))
    trained["data"] |= {"root": "here", "labels": "x"}
    data = OmegaConf.to_container(merged(trained, asked))["data"]
    for key, value in kept.items():
        assert data[key] == value
    assert data["shot"]["radius"] == 0.3


# ------------------------------------------------------------------- the truth within a face


class Blurred(ShapeSet):
    """The template itself, its truth moved into a face beside each vertex."""

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


@pytest.fixture
def blurred(tmp_path):
    return CorrespondenceData(Blurred(), Recipe(0.3, 4, 8), Store(tmp_path), workers=1)


@pytest.mark.parametrize("shuffled", [False, True])
def test_an_error_is_measured_to_the_point_and_to_the_label_beside_it(blurred, shuffled):
    blurred.shuffle_vertices = shuffled
    blurred.prepare(["test"])
    item = blurred.datasets["test"][0]
    labels, place = item["labels"].numpy(), blurred.reference.place
    result = result_of(labels, item, blurred.reference)
    assert (result.label_errors == 0).all()
    point = np.einsum("vk,vkx->vx", item["weights"], place[item["corners"]])
    np.testing.assert_allclose(result.errors, np.linalg.norm(point - place[labels], axis=1))
    outcome = Outcome.of(["c"], [item], {0: result}, blurred.reference.diameter)
    figures, curve = outcome.figures()
    assert figures["geodesic_error"] > 0 == figures["geodesic_error_to_label"]
    assert figures["exact_match"] == 1 and curve[0] == 0


def test_the_distance_to_a_point_lies_between_those_to_its_corners(blurred):
    reference, template = blurred.reference, blurred.shapes.template
    corners = template.faces[:50]
    predicted = np.full(50, 160)
    near = (corners == 160).any(axis=1)
    each = np.stack([reference(corner, predicted) for corner in corners.T], axis=1)
    error = point_errors(predicted, corners, np.full((50, 3), 1 / 3), reference, reference.place)
    np.testing.assert_allclose(error[~near], each[~near].mean(axis=1))
    at_corner = point_errors(
        predicted, corners, np.eye(3)[np.zeros(50, int)], reference, reference.place
    )
    np.testing.assert_allclose(at_corner[~near], each[~near, 0], rtol=1e-6)


def test_points_must_be_on_the_template():
    mesh = toy_shapes()["template.ply"]
    labels, ones = np.arange(162), np.ones((162, 3)) / 3
    for corners in (np.full((162, 3), 162), np.full((162, 3), -1)):
        with pytest.raises(DataError, match=r"162 points outside 0\.\.161"):
            Shape(mesh, labels, 162, SurfacePoints(corners, ones))
    with pytest.raises(DataError, match="162 vertices but points"):
        Shape(mesh, labels, 162, SurfacePoints(np.zeros((9, 3), int), ones))


# ----------------------------------------------------------------------------------- pictures


def test_shapes_are_chosen_evenly():
    names = list("abcdefghij")
    assert evenly(names, 4) == ["a", "d", "g", "j"]
    assert evenly(names, 100) == names and evenly(names, 1) == ["a"]


def test_error_colours_darken_and_end_at_a_fifth():
    grey = error_colors(np.linspace(0, 0.3, 31)) @ [0.299, 0.587, 0.114]
    assert (np.diff(grey[:21]) < 0).all() and (np.diff(grey[20:]) == 0).all()


def test_no_two_curves_look_alike_and_no_name_covers_one():
    curves = {f"run {i}": (THRESHOLDS, np.full(len(THRESHOLDS), i / 24)) for i in range(24)}
    figure = curve_figure(curves)
    [axes] = figure.axes
    assert len({(line.get_color(), line.get_linestyle()) for line in axes.lines}) == 24
    FigureCanvasAgg(figure).draw()
    [legend] = figure.legends
    names = legend.get_window_extent()
    assert len(legend.get_texts()) == 24
    assert names.x0 >= axes.get_window_extent().x1 and names.y0 >= 0


def test_curves_of_several_runs_have_a_band():
    curves = np.stack([THRESHOLDS, THRESHOLDS / 2])
    [axes] = curve_figure({"a": (THRESHOLDS, curves), "b": (THRESHOLDS, THRESHOLDS)}).axes
    assert len(axes.collections) == 1 and len(axes.lines) == 2
    np.testing.assert_allclose(axes.lines[0].get_ydata(), 75 * THRESHOLDS)
    figure = all_curves_figure(THRESHOLDS, curves)
    assert len(figure.axes[0].lines) == 2
    assert encoded(figure, "svg") == encoded(figure, "svg")


def test_a_flat_mesh_is_drawn():
    mesh = lattice(4, 4)
    rows = []
    for axis in range(3):
        flat = Mesh(np.insert(mesh.vertices[:, :2], axis, 0.0, axis=1), mesh.faces)
        rows.append(Row([flat], [np.ones((16, 3))]))
        assert encoded(sketch_figure(flat.vertices, flat.faces, rows[-1].colors[0]), "png")
    for picture in render(rows, "y"):
        assert picture.images[0].shape[1] < 25 * picture.images[0].shape[0]


def test_a_checkpoint_knows_its_template(trained):
    saved = torch.load(trained[0] / BEST, weights_only=True)
    faces = toy_shapes()["template.ply"].faces
    np.testing.assert_array_equal(template_of(saved).faces, faces)
    assert saved["resolution"] > 0 and "optimizer_states" not in saved
