"""Remeshed data sets: made once, with a truth that lies within faces."""

from __future__ import annotations

import json

import numpy as np
import pytest
from tqdm import tqdm

from meshspiral.commands.meshes import COLUMNS, edges, main, row, shared
from meshspiral.data.cache import Store
from meshspiral.data.preprocessing import _run_in_pool
from meshspiral.data.remeshed import Remeshed, usual_size
from meshspiral.data.shapes import DataError, ShapeSet, registered_shape
from meshspiral.data.sources import open_shapes
from meshspiral.evaluation.outcome import ERRORS, Outcome
from meshspiral.experiment.runs import METRICS
from meshspiral.geometry import remesh as module
from tests.commands.test_train import FIGURES, run
from tests.conftest import toy_shapes
from tests.experiment.test_cli import cli  # noqa: F401
from tests.meshes import bow_tie, punctured


class Toys(ShapeSet):
    def __init__(self):
        self._shapes = toy_shapes()
        self.template = self._shapes["template.ply"]
        self.names = {
            "train": ["train/0.ply", "train/1.ply"],
            "val": ["val/0.ply"],
            "test": ["test/0.ply"],
        }

    def load(self, name):
        return registered_shape(self._shapes[name], self.template)


@pytest.fixture
def toys(tmp_path):
    return Remeshed(Toys(), Store(tmp_path), 1, "isotropic", 120)


def test_a_shape_is_remeshed_once_and_kept(toys, monkeypatch):
    toys.prepare(["train/0.ply", "train/1.ply"])
    monkeypatch.setattr(module, "remesh", None)  # from here on it would fail
    shape = toys.load("train/0.ply")
    assert len(shape.mesh.vertices) == 120 and shape.template_size == 162
    again = toys.load("train/0.ply")
    np.testing.assert_array_equal(shape.mesh.vertices, again.mesh.vertices)
    with pytest.raises(TypeError):
        toys.load("val/0.ply")


def test_a_pool_makes_the_same_meshes(toys, tmp_path):
    names = ["train/0.ply", "train/1.ply", "val/0.ply"]
    tasks = [toys._task(toys.source(name).mesh, 1) for name in names]
    _run_in_pool(tasks, Store(tmp_path / "pool"), 2, tqdm(disable=True))
    pooled = Remeshed(Toys(), Store(tmp_path / "pool"), 1, "isotropic", 120)
    for name in names:
        here, there = toys.load(name).mesh, pooled.load(name).mesh
        np.testing.assert_array_equal(there.vertices, here.vertices)
        np.testing.assert_array_equal(there.faces, here.faces)


def test_training_shapes_can_have_several_tessellations(tmp_path):
    shapes = Remeshed(Toys(), Store(tmp_path), 1, "isotropic", 120, copies=3)
    names = ["train/0.ply", "train/0.ply~2", "train/0.ply~3"]
    assert shapes.names["train"] == [
        names[0],
        "train/1.ply",
        names[1],
        "train/1.ply~2",
        names[2],
        "train/1.ply~3",
    ]
    assert shapes.names["val"] == ["val/0.ply"]
    shapes.prepare(names)
    loaded = [shapes.load(name).mesh.vertices for name in names]
    assert not np.allclose(loaded[0], loaded[1]) and not np.allclose(loaded[1], loaded[2])
    once = Remeshed(Toys(), Store(tmp_path), 1, "isotropic", 120).load(names[0])
    np.testing.assert_array_equal(once.mesh.vertices, loaded[0])
    assert shapes.source(names[2]).mesh.name == shapes.source(names[0]).mesh.name


def test_the_truth_is_where_the_vertex_lies(toys):
    """On the shape itself: the template's point, carried over, is at the vertex."""
    shape, source = toys.load("test/0.ply"), toys.source("test/0.ply").mesh
    point = np.einsum("vk,vkx->vx", shape.points.weights, source.vertices[shape.points.corners])
    assert np.linalg.norm(point - shape.mesh.vertices, axis=1).max() < 0.05
    place = toys.template.vertices
    point = np.einsum("vk,vkx->vx", shape.points.weights, place[shape.points.corners])
    each = np.linalg.norm(place[shape.points.corners] - point[:, None], axis=2)
    chosen = np.linalg.norm(place[shape.labels] - point, axis=1)
    np.testing.assert_allclose(chosen, each.min(axis=1))


def test_no_two_shapes_have_their_edges_in_common(tmp_path):
    """The bodies themselves: under half of the edges, as the template reads them."""
    remesh = {"policy": "isotropic", "vertices": 1100}
    kept = {"cache_dir": str(tmp_path), "workers": 1}
    shapes = open_shapes({"name": "bodies", "vertices": 1500, "remesh": remesh, **kept})
    one, two = (shapes.load(name) for name in shapes.names["test"][:2])
    assert 0 < shared(one, two) < 0.5
    registered = [shapes.source(name) for name in shapes.names["test"][:2]]
    assert shared(*registered) == 1
    assert len(edges(registered[0])) == len(registered[0].mesh.faces) * 3 // 2


def test_the_table_sees_a_bow_tie_and_what_was_torn(toys):
    def columns(mesh):
        shape = registered_shape(mesh, mesh)
        return dict(zip(COLUMNS, row(shape, None, toys, "val/0.ply"), strict=True))

    assert not columns(bow_tie())["manifold"]
    whole = toys.source("val/0.ply").mesh
    assert columns(whole)["manifold"] and columns(whole)["as source"]
    torn = columns(punctured(whole, 0.05))
    assert not torn["closed"] and not torn["as source"]


@pytest.mark.parametrize("template, size", [(6890, 5000), (1500, 1100), (162, 118), (10, 12)])
def test_the_usual_size(template, size):
    assert usual_size(template) == size


def test_another_policy_or_size_is_another_mesh(toys, tmp_path):
    one = toys.load("val/0.ply").mesh
    for policy, size in (("isotropic", 110), ("adaptive", 120)):
        other = Remeshed(Toys(), Store(tmp_path), 1, policy, size).load("val/0.ply").mesh
        assert other.vertices.shape != one.vertices.shape or (other.vertices != one.vertices).any()


def test_without_pymeshlab_there_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("meshspiral.data.remeshed.version", lambda _: raise_missing())
    with pytest.raises(DataError, match=r"pip install -e '.\[remesh\]'"):
        Remeshed(Toys(), Store(tmp_path), 1, "isotropic", 120)


def raise_missing():
    from importlib.metadata import PackageNotFoundError

    raise PackageNotFoundError("pymeshlab")


REMESHED = "data=bodies_remeshed"
REMESH = ["+data.remesh.policy=mixed", "+data.remesh.vertices=120"]


@pytest.mark.parametrize("model", [["metric=true"], ["model=gcnn3", "model.patch.radius=0.2"]])
def test_networks_train_on_remeshed_shapes(toy_overrides, tmp_path, model):
    metrics = run(tmp_path, [*toy_overrides, *REMESH, *model, "optim.epochs=1"])
    assert metrics.keys() >= FIGURES
    outcome = Outcome.load(tmp_path / ERRORS)
    assert (outcome.errors != outcome.label_errors).mean() > 0.9  # hardly any truth is a vertex
    assert json.loads((tmp_path / METRICS).read_text()) == metrics


def test_the_meshes_of_a_data_set_in_a_table(cli, toy_overrides):  # noqa: F811
    data = [o for o in toy_overrides if o.startswith("data") and "shot" not in o]
    code, out, err = cli(*data, *REMESH, "split=test", program=main)
    assert code == 0, err
    lines = [line.split() for line in out.splitlines() if line.startswith(("test_", "mean"))]
    assert [line[0] for line in lines] == ["test_0", "test_1", "test_2", "mean"]
    for line in lines[:-1]:
        assert 114 <= int(line[1]) <= 120 and line[4:8] == ["yes", "yes", "0", "yes"]
    assert float(lines[-1][10]) < 0.8  # shared edges
    code, out, err = cli(*data, "split=test", program=main)  # as registered
    lines = [line.split() for line in out.splitlines() if line.startswith("test_")]
    assert code == 0 and all(line[7] == "-" and line[10:] == ["1.00", "-", "-"] for line in lines)
    code, out, err = cli(*data, *REMESH, "data.val=[val/0.ply]", "split=val", program=main)
    assert code == 0 and out.splitlines()[-2].split()[10] == "-"  # one mesh, nothing to compare
    code, out, err = cli(*data, "data.val=[]", "split=val", program=main)
    assert code == 1 and "has no mesh in its split val" in out + err


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["split=exam"], "split must be one of train, val, test; got exam"),
        ([REMESHED, "data.remesh.policy=knitted"], "data.remesh.policy must be one of"),
        ([REMESHED, "data.remesh.vertices=3"], "data.remesh.vertices must be at least 12"),
        ([REMESHED, "+data.remesh.depth=3"], "unknown key data.remesh.depth"),
    ],
)
def test_a_mistake_is_one_clear_line(cli, arguments, message):  # noqa: F811
    code, out, err = cli(*arguments, program=main)
    assert code == 1 and message in (out + err).strip().splitlines()[-1]
