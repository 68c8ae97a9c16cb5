"""Random bodies; what needs Anny is skipped without it."""

from __future__ import annotations

import copy
import importlib.util
import pickle

import numpy as np
import pytest
from scipy.spatial import cKDTree

from meshspiral.data import posing
from meshspiral.data.datasets import anny as module
from meshspiral.data.datasets.anny import AGES, Anny, Surface, draw_person
from meshspiral.data.datasets.bodies import Bodies
from meshspiral.data.shapes import DataError
from meshspiral.geometry.barycentric import interpolate
from meshspiral.geometry.mesh import Mesh

installed = pytest.mark.skipif(
    importlib.util.find_spec("anny") is None, reason="needs Anny: pip install -e '.[anny]'"
)


def test_people_differ_and_lie_in_their_ranges():
    people = [draw_person(np.random.default_rng(i), "adults") for i in range(200)]
    values = {name: np.array([person[name] for person in people]) for name in people[0]}
    assert all((v >= 0).all() and (v <= 1).all() and v.std() > 0.1 for v in values.values())
    assert AGES["adults"][0] <= values["age"].min() and values["age"].max() <= AGES["adults"][1]
    origin = values["african"] + values["asian"] + values["caucasian"]
    np.testing.assert_allclose(origin, 1)
    ages = [draw_person(np.random.default_rng(i), "all")["age"] for i in range(200)]
    assert min(ages) < 0.3 and max(ages) > 0.95


@pytest.mark.parametrize("vertices", [1500, 6890])
def test_the_surface_has_the_vertices_of_the_template(vertices):
    """On a plane in place of Anny's vertices, all points stay on it."""
    surface = Surface(vertices)
    rng = np.random.default_rng(0)
    plane = rng.normal(size=(20_000, 3))
    plane[:, 2] = 3 * plane[:, 0] - plane[:, 1]
    points = surface.of(plane)
    assert points.shape == (vertices, 3)
    off = points[:, 2] - 3 * points[:, 0] + points[:, 1]
    np.testing.assert_allclose(off, off[0], atol=1e-6)


@pytest.fixture
def people(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: True)
    return lambda **more: Anny(
        **{"vertices": 1500, "subjects": 2, "poses": 3, "ages": "adults", "people_seed": 0, **more}
    )


@pytest.mark.parametrize("folds, taken, drawn", [([5, 3, 4, 6, 3, 9, 9, 9], 1, 8), ([5, 0], 1, 2)])
def test_the_pose_that_folds_the_surface_least_is_taken(people, monkeypatch, folds, taken, drawn):
    bodies, counts = [], iter(folds)

    class Model:
        def posed(self, traits, pose):
            bodies.append(np.random.default_rng(len(bodies)).normal(size=(20_000, 3)))
            return bodies[-1]

    monkeypatch.setattr(module, "body_model", Model)
    monkeypatch.setattr(module, "folded_faces", lambda mesh: next(counts))
    shape = people().load("train_0000_00")
    assert len(bodies) == drawn
    np.testing.assert_allclose(shape.mesh.vertices, Surface(1500).of(bodies[taken]), atol=1e-6)


def test_other_people_are_validated_and_tested_on(people):
    few, many = people(), people(subjects=40)
    assert [len(few.names[split]) for split in ("train", "val", "test")] == [6, 30, 30]
    assert few.names["test"] == many.names["test"]
    everyone = [name for names in many.names.values() for name in names]
    assert len({name.rpartition("_")[0] for name in everyone}) == 40 + 10 + 10
    with pytest.raises(DataError, match="no body is named 'train_0002_00'"):
        few.load("train_0002_00")


def test_bodies_with_more_vertices_are_labelled_with_points_of_the_template(people):
    assert people()._labels is None
    shapes = people(surface=6890)
    labels, size, points = shapes._labels
    bodies = Bodies(6890).template
    assert size == 1500 and len(labels) == 6890
    found = interpolate(shapes.template.vertices, *points)
    assert np.linalg.norm(found - bodies.vertices, axis=1).max() < 0.5 * shapes.template.mean_edge
    nearest = cKDTree(shapes.template.vertices).query(found)[1]
    assert (
        labels == nearest
    ).mean() > 0.99  # of the corners; a corner of a neighbour may be nearer


@installed
def test_persons_and_poses_are_drawn_independently_and_bodies_have_few_digits(people, monkeypatch):
    shapes, drawn = people(), []

    def record(place, name):
        real = getattr(place, name)

        def draw(rng, *rest):
            drawn.append(copy.deepcopy(rng).random())
            return real(rng, *rest)

        monkeypatch.setattr(place, name, draw)

    record(module, "draw_person")
    record(posing, "draw_pose")
    vertices = shapes.load("train_0000_00").mesh.vertices
    assert len(drawn) > 1 and len(set(drawn)) == len(drawn)
    np.testing.assert_array_equal(vertices, vertices.round(6))


def test_without_anny_one_line_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "anny" else True)
    with pytest.raises(DataError, match=r"data=anny needs anny: pip install -e '\.\[anny\]'"):
        Anny(1500, 2, 3, "adults", 0)


def test_later_epochs_show_other_people(people, monkeypatch):
    shapes = people()
    drawn = []
    monkeypatch.setattr(module, "draw_person", lambda rng, ages: drawn.append(rng.random()) or {})
    monkeypatch.setattr(module, "body_model", no_model)
    for name in ("train_0000_01", "train_0001_02", "train_0000_01@1", "train_0000_02@1"):
        with pytest.raises(KeyError, match="no model"):
            shapes.load(name)
    assert drawn[2] == drawn[3] and len(set(drawn)) == 3  # person 2 is not among the first two


def no_model():
    raise KeyError("no model")


@installed
def test_a_body_follows_from_its_name_and_is_human():
    shapes = Anny(1500, 2, 3, "adults", 0)
    shape = shapes.load("train_0001_02")
    again = pickle.loads(pickle.dumps(shapes)).load("train_0001_02")
    np.testing.assert_array_equal(again.mesh.vertices, shape.mesh.vertices)
    other, resting = shapes.load("train_0001_01").mesh, Bodies(1500).template
    assert not np.allclose(other.vertices, shape.mesh.vertices)
    for mesh in (shape.mesh, other):
        ratio = np.sqrt(mesh.area / resting.area)
        assert 0.75 < ratio < 1.25 and mesh.vertices[:, 2].min() == pytest.approx(0, abs=0.02)
    lengths = [edge_lengths(mesh) for mesh in (shape.mesh, resting)]
    assert np.corrcoef(*np.log(lengths))[0, 1] > 0.8


def edge_lengths(mesh: Mesh) -> np.ndarray:
    a, b = mesh.vertices[mesh.faces[:, 0]], mesh.vertices[mesh.faces[:, 1]]
    return np.linalg.norm(a - b, axis=1)
