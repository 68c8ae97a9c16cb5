"""Remeshed data sets: computed once, with ground truth within faces of the template."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh

from meshspiral.data import preprocessing
from meshspiral.data.cache import Cache
from meshspiral.data.pool import run_in_pool
from meshspiral.data.remeshed import Remeshed, torn, usual_size
from meshspiral.data.shapes import (
    DataError,
    Shape,
    ShapeSet,
    SurfacePoints,
    name_in,
    registered_shape,
)
from meshspiral.evaluation.outcome import Outcome
from meshspiral.experiment.run_folder import ERRORS, METRICS
from meshspiral.geometry import remesh as module
from meshspiral.geometry.barycentric import interpolate
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.remesh import closest_points
from tests import helpers
from tests.conftest import toy_shapes
from tests.helpers import run
from tests.meshes import lattice, two_boxes


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
    return Remeshed(Toys(), Cache(tmp_path), 1, "isotropic", 120)


def test_a_shape_is_remeshed_once_and_cached(toys, monkeypatch):
    toys.prepare(["train/0.ply", "train/1.ply"])
    monkeypatch.setattr(module, "remesh", None)  # remeshing now fails
    shape = toys.load("train/0.ply")
    assert len(shape.mesh.vertices) == 120 and shape.template_size == 162
    again = toys.load("train/0.ply")
    np.testing.assert_array_equal(shape.mesh.vertices, again.mesh.vertices)
    with pytest.raises(TypeError):
        toys.load("val/0.ply")


def test_training_shapes_may_share_tessellations(tmp_path):
    shapes = Remeshed(Toys(), Cache(tmp_path), 1, "isotropic", 120, copies=3, shared=1)
    names = shapes.names["train"]
    assert len(names) == 6
    first, *others = (shapes.load(name) for name in names)
    for other in others:
        np.testing.assert_array_equal(other.mesh.faces, first.mesh.faces)
        np.testing.assert_array_equal(other.points.weights, first.points.weights)
    registered = Toys().load("train/1.ply").mesh
    _, _, off = closest_points(
        registered, shapes.load("train/1.ply").mesh.vertices, np.full((120, 3), np.nan)
    )
    assert off.max() < 1e-9  # the shape's own surface, not that of the first
    own = shapes.load("val/0.ply").mesh
    assert own.faces.shape != first.mesh.faces.shape or (own.faces != first.mesh.faces).any()
    tetrahedron = Mesh(np.eye(4, 3), [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    load = shapes.base.load
    shapes.base.load = lambda name: (
        Shape(tetrahedron, np.arange(4), 162) if name == "train/1.ply" else load(name)
    )
    with pytest.raises(DataError, match=r"data\.remesh\.shared needs shapes with the same faces"):
        shapes.load("train/1.ply")
    with pytest.raises(DataError, match="at most 2, the number of training shapes, got 3"):
        Remeshed(Toys(), Cache(tmp_path), 1, "isotropic", 120, shared=3)


def test_a_shape_is_prepared_anew_once_the_one_it_is_remeshed_as_has_changed(tmp_path):
    class Stamped(Toys):
        changed = ""

        def stamp(self, name):
            return f"{name} {'new' if name == self.changed else 'old'}"

    toys = Stamped()
    shapes = Remeshed(toys, Cache(tmp_path), 1, "isotropic", 120, copies=4, shared=2)
    names = shapes.names["train"]
    before = {name: shapes.stamp(name) for name in names}
    for toys.changed in ("train/0.ply", "train/1.ply"):
        for name in names:
            drawn = shapes._pattern(name) == toys.changed
            itself = name.partition("~")[0] == toys.changed
            assert (shapes.stamp(name) != before[name]) == (drawn or itself)
    assert {shapes._pattern(name) for name in names} == {"train/0.ply", "train/1.ply"}


def test_each_shape_draws_its_size_from_a_range(tmp_path):
    shapes = Remeshed(Toys(), Cache(tmp_path), 1, "isotropic", [80, 160], copies=3)
    sizes = {len(shapes.load(name).mesh.vertices) for name in shapes.names["train"]}
    assert len(sizes) > 3 and min(sizes) >= 80 and max(sizes) <= 160


def test_labels_of_a_finer_surface_are_points_of_the_template(tmp_path):
    class Finer(Toys):
        """The shapes with faces split in four; new vertices are midpoints of the template's."""

        def load(self, name):
            coarse = super().load(name).mesh
            vertices, faces = trimesh.remesh.subdivide(coarse.vertices, coarse.faces)
            points, _ = trimesh.remesh.subdivide(self.template.vertices, self.template.faces)
            face, weights, _ = closest_points(self.template, points, np.full_like(points, np.nan))
            corners = self.template.faces[face].astype(np.int64)
            labels = corners[np.arange(len(corners)), weights.argmax(axis=1)]
            size = len(self.template.vertices)
            return Shape(Mesh(vertices, faces), labels, size, SurfacePoints(corners, weights))

    toys = Finer()
    shape = Remeshed(toys, Cache(tmp_path), 1, "isotropic", 120).load("test/0.ply")
    template, registered = toys.template, Toys().load("test/0.ply").mesh
    face, weights, _ = closest_points(
        registered, shape.mesh.vertices, np.full_like(shape.mesh.vertices, np.nan)
    )
    expected = interpolate(template.vertices, template.faces[face], weights)
    found = interpolate(template.vertices, *shape.points)
    edge = np.linalg.norm(np.diff(template.vertices[template.faces[:, :2]], axis=1), axis=2).mean()
    assert np.linalg.norm(found - expected, axis=1).max() < 0.1 * edge


def test_a_pool_computes_the_same_meshes(toys, tmp_path):
    names = ["train/0.ply", "train/1.ply", "val/0.ply"]
    cache = Cache(tmp_path / "pool")
    jobs = [(toys._task(toys.source(name).mesh, 1), cache) for name in names]
    assert len(list(run_in_pool(preprocessing.ensure_task, jobs, 2, "data.workers=1"))) == 3
    pooled = Remeshed(Toys(), cache, 1, "isotropic", 120)
    for name in names:
        here, there = toys.load(name).mesh, pooled.load(name).mesh
        np.testing.assert_array_equal(there.vertices, here.vertices)
        np.testing.assert_array_equal(there.faces, here.faces)


@pytest.mark.parametrize("shared", [None, 1])
def test_later_epochs_have_other_tessellations_of_the_same_shape(tmp_path, shared):
    shapes = Remeshed(Toys(), Cache(tmp_path), 1, "isotropic", 120, copies=2, shared=shared)
    assert shapes.fresh
    names = [name_in(e, n) for e in (0, 1, 2) for n in ("train/0.ply", "train/0.ply~2")]
    meshes = [shapes.load(name).mesh for name in names]
    if shared:  # there is one tessellation
        assert all((mesh.faces == meshes[0].faces).all() for mesh in meshes)
    else:
        assert len({mesh.vertices.tobytes() for mesh in meshes}) == 6
    own = Toys().load("train/0.ply").mesh
    for mesh in meshes:
        _, _, off = closest_points(own, mesh.vertices, np.full(mesh.vertices.shape, np.nan))
        assert off.max() < 0.05


def test_a_load_makes_the_original_shape_once(tmp_path, monkeypatch):
    shapes, made = Remeshed(Toys(), Cache(tmp_path), 1, "isotropic", 120), []
    load = Toys.load
    monkeypatch.setattr(Toys, "load", lambda self, name: made.append(name) or load(self, name))
    shapes.load("train/0.ply")
    assert made == ["train/0.ply"]


def test_training_shapes_can_have_several_tessellations(tmp_path):
    shapes = Remeshed(Toys(), Cache(tmp_path), 1, "isotropic", 120, copies=3)
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
    once = Remeshed(Toys(), Cache(tmp_path), 1, "isotropic", 120).load(names[0])
    np.testing.assert_array_equal(once.mesh.vertices, loaded[0])
    assert shapes.source(names[2]).mesh.name == shapes.source(names[0]).mesh.name


def test_the_ground_truth_is_the_point_at_the_vertex(toys):
    """Carried over to the original shape, the template's point is at the remeshed vertex."""
    shape, source = toys.load("test/0.ply"), toys.source("test/0.ply").mesh
    point = np.einsum("vk,vkx->vx", shape.points.weights, source.vertices[shape.points.corners])
    assert np.linalg.norm(point - shape.mesh.vertices, axis=1).max() < 0.05
    template = toys.template.vertices
    point = np.einsum("vk,vkx->vx", shape.points.weights, template[shape.points.corners])
    to_corners = np.linalg.norm(template[shape.points.corners] - point[:, None], axis=2)
    to_label = np.linalg.norm(template[shape.labels] - point, axis=1)
    np.testing.assert_allclose(to_label, to_corners.min(axis=1))


@pytest.mark.parametrize("template, size", [(6890, 5000), (1500, 1100), (162, 118), (10, 12)])
def test_the_usual_size(template, size):
    usual = usual_size(template)
    assert usual == size and isinstance(usual, int)  # PyMeshLab takes no 1100.0


def test_another_policy_or_size_is_another_mesh(toys, tmp_path):
    one = toys.load("val/0.ply").mesh
    for policy, size in (("isotropic", 110), ("adaptive", 120)):
        other = Remeshed(Toys(), Cache(tmp_path), 1, policy, size).load("val/0.ply").mesh
        assert other.vertices.shape != one.vertices.shape or (other.vertices != one.vertices).any()


def test_without_pymeshlab_one_message_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setattr("meshspiral.data.remeshed.version", lambda _: raise_missing())
    with pytest.raises(DataError, match="pip install pymeshlab"):
        Remeshed(Toys(), Cache(tmp_path), 1, "isotropic", 120)


def raise_missing():
    from importlib.metadata import PackageNotFoundError

    raise PackageNotFoundError("pymeshlab")


REMESH = ["data/remesh=mixed", "data.remesh.vertices=120"]


@pytest.mark.parametrize("model", [["metric=true"], ["model=gcnn3", "neighbourhood.radius=0.2"]])
def test_networks_train_on_remeshed_shapes(toy_overrides, tmp_path, model):
    metrics = run(tmp_path, [*toy_overrides, *REMESH, *model, "optim.epochs=1"])
    assert metrics.keys() >= helpers.METRICS
    outcome = Outcome.load(tmp_path / ERRORS)
    mean = outcome.label_errors.mean(dtype=np.float64)
    assert metrics["test/geodesic_error_to_label"] == pytest.approx(mean)
    assert (outcome.errors != outcome.label_errors).mean() > 0.9  # few true points are vertices
    assert json.loads((tmp_path / METRICS).read_text()) == metrics


def test_faces_tear_where_a_shared_tessellation_joins_what_is_apart_in_another_shape():
    """Two squares side by side, joined by faces; in the other shape one of them is far away."""
    mesh = lattice(2, 6)
    right = mesh.vertices[:, 0] > mesh.vertices[:, 0].max() / 2
    apart = mesh.vertices + 10.0 * right[:, None] * [1, 0, 0]
    across = right[mesh.faces].any(axis=1) & ~right[mesh.faces].all(axis=1)
    assert 0 < across.sum() < len(across) / 2
    np.testing.assert_array_equal(torn(mesh.vertices, 3 * apart, mesh.faces), across)
    assert not torn(mesh.vertices, 3 * mesh.vertices, mesh.faces).any()


class Hands(Toys):
    """Shapes in which two boxes nearly touch, and shapes in which they are apart."""

    def __init__(self):
        super().__init__()
        self.gaps = {"a": 0.03, "b": 0.3}
        self.names = {"train": ["a", "b"], "val": [], "test": []}
        self.template = two_boxes(self.gaps["a"])

    def load(self, name: str) -> Shape:
        return registered_shape(two_boxes(self.gaps[name]), self.template)


def test_what_is_fused_in_one_shape_is_torn_in_another(tmp_path, monkeypatch):
    monkeypatch.setattr("meshspiral.geometry.remesh.FUSED", (0.02, 0.02))
    shapes = Remeshed(Hands(), Cache(tmp_path), 1, "fused", 300, shared=1)
    fused, apart = (shapes.load(name) for name in ("a", "b"))
    pieces = [
        trimesh.Trimesh(s.mesh.vertices, s.mesh.faces, process=False).body_count
        for s in (fused, apart)
    ]
    assert pieces == [1, 2]
    assert len(apart.mesh.vertices) == len(apart.labels) == len(apart.points.weights)
