"""Refinement by the labels of neighbours, against the sums of its definition."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from meshspiral import Matcher, Mesh, scan
from meshspiral.data.datasets.bodies import Bodies
from meshspiral.matching import mean_field
from meshspiral.matching.mean_field import (
    REACH,
    STRENGTH,
    WIDTH,
    MeanField,
    likeliest_near,
    neighbour_mean,
)
from tests.meshes import bumpy_sphere, punctured

SPHERE = bumpy_sphere(subdivisions=3)


def likely(labels: np.ndarray, wrong: np.ndarray, template: int) -> np.ndarray:
    """Log-probabilities that prefer `labels`, but at `wrong` the opposite label a little."""
    scores = np.zeros((len(labels), template), dtype=np.float32)
    scores[np.arange(len(labels)), labels] = 9.0
    scores[wrong, (labels[wrong] + template // 2) % template] = 9.5
    return torch.log_softmax(torch.from_numpy(scores), 1).numpy()


def test_the_mean_over_the_one_ring():
    mean = neighbour_mean(SPHERE)
    values = np.random.default_rng(0).normal(size=len(SPHERE.vertices))
    for vertex in (0, 17, 200):
        ring = np.unique(SPHERE.faces[(SPHERE.faces == vertex).any(axis=1)])
        expected = values[ring[ring != vertex]].mean()
        assert (mean @ values)[vertex] == pytest.approx(expected, rel=1e-5)


def test_one_step_is_that_of_the_definition(monkeypatch):
    monkeypatch.setattr(mean_field, "STEPS", 1)
    rng = np.random.default_rng(1)
    size = len(SPHERE.vertices)
    scores = torch.from_numpy(rng.normal(size=(size, size)).astype(np.float32) * 4)
    log_probability = torch.log_softmax(scores, 1).numpy()
    found = MeanField(SPHERE)(log_probability, SPHERE)
    apart = np.linalg.norm(SPHERE.vertices[:, None] - SPHERE.vertices, axis=2) / SPHERE.size
    kernel = np.where(apart <= REACH * WIDTH, np.exp(-((apart / WIDTH) ** 2) / 2), 0)
    field = neighbour_mean(SPHERE) @ np.exp(log_probability)
    expected = (log_probability + STRENGTH * field @ kernel).argmax(axis=1)
    assert (found == expected).mean() > 0.999  # float32 may decide between equals otherwise


def test_on_a_dense_mesh_a_message_passes_several_edges(monkeypatch):
    monkeypatch.setattr(mean_field, "STEPS", 1)
    template, rng = bumpy_sphere(subdivisions=2), np.random.default_rng(1)
    places, size = template.vertices, template.size
    scores = torch.from_numpy(rng.normal(size=(len(SPHERE.vertices), 162)).astype(np.float32) * 4)
    log_probability = torch.log_softmax(scores, 1).numpy()
    apart = np.linalg.norm(places[:, None] - places, axis=2) / size
    kernel = np.where(apart <= REACH * WIDTH, np.exp(-((apart / WIDTH) ** 2) / 2), 0)
    field = np.exp(log_probability)
    for _ in range(4):  # 642 vertices, four times as many
        field = neighbour_mean(SPHERE) @ field
    expected = (log_probability + STRENGTH * field @ kernel).argmax(axis=1)
    found = MeanField(template)(log_probability, SPHERE)
    assert (found == expected).mean() > 0.99


@pytest.mark.parametrize("mesh", [SPHERE, punctured(SPHERE, 0.1)])
def test_scattered_errors_take_the_labels_of_their_neighbours(mesh):
    labels = np.arange(len(SPHERE.vertices))
    wrong = np.random.default_rng(0).choice(labels, 60, replace=False)
    faces = np.bincount(mesh.faces.ravel(), minlength=len(labels))[wrong]
    log_probability = likely(labels, wrong, len(labels))
    assert (log_probability.argmax(axis=1)[wrong] != wrong).all()
    found = MeanField(SPHERE)(log_probability, mesh)
    apart = np.linalg.norm(SPHERE.vertices[found] - SPHERE.vertices, axis=1) / SPHERE.size
    assert (apart[wrong][faces > 2] < 0.1).mean() > 0.95
    right = np.setdiff1d(labels, wrong)
    assert (found[right] == right).mean() > 0.99


def test_the_likeliest_label_near_another():
    """On a line, with a sure label far away, a likely one near, and nothing else."""
    far, near, at = 0, 41, 40
    vertices = np.array([[k, 0, 0] for k in range(60)], dtype=float)
    vertices[-1, 1] = 1.0  # or the faces had no area
    faces = np.stack([np.arange(58), np.arange(1, 59), np.full(58, 59)], axis=1)
    template = Mesh(vertices, faces)
    scores = np.full((1, 60), -20.0, dtype=np.float32)
    scores[0, [far, near]] = 0.0, -3.0
    squares = (np.array([near, far]) - at) ** 2 / template.area / (2 * mean_field.NEAR**2)
    expected = near if -3.0 - squares[0] > -squares[1] else far
    assert expected == near
    assert likeliest_near(scores, np.array([at]), template).tolist() == [near]
    scores[0, near] = -20.0
    assert likeliest_near(scores, np.array([far]), template).tolist() == [far]


def test_the_bundled_network_errs_less_with_it():
    bodies = Bodies(1500)
    place = bodies.template.vertices
    meshes = [bodies.load(name).mesh for name in bodies.names["val"][:3]]
    errors = []
    for refine in (None, "crf", "zoomout"):
        matcher = Matcher.load(refine=refine)
        labels = [matcher.label(scan(mesh.vertices, mesh.faces, "a")) for mesh in meshes]
        off = [np.linalg.norm(place[each.template] - place, axis=1).mean() for each in labels]
        errors.append(np.mean(off))
        confidence = np.concatenate([each.confidence for each in labels])
        assert confidence.min() >= 0 and confidence.max() <= 1
    assert errors[1] < errors[0] and errors[2] < errors[0]
