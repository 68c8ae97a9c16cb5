"""The probability that a match is right: closed forms, brute force, and bodies."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from meshspiral import Matcher, Mesh, scan
from meshspiral.data.datasets.bodies import Bodies
from meshspiral.evaluation.distributions import Distributions, near_vertices, soft_points
from meshspiral.matching.confidence import RADIUS, map_confidence, near_confidence
from tests.meshes import lattice

TEMPLATE = lattice(30, 40)
SIZE = len(TEMPLATE.vertices)


def distributions(probabilities, row_of=None) -> Distributions:
    """Those of given rows [W, K]: the layer is the identity."""
    rows = torch.from_numpy(np.log(np.asarray(probabilities) + 1e-30))
    row_of = np.arange(len(rows)) if row_of is None else np.array(row_of)
    size = rows.shape[1]
    return Distributions(
        rows, torch.eye(size, dtype=rows.dtype), torch.zeros(size).double(), row_of
    )


def one_hot(*vertices) -> np.ndarray:
    return np.eye(SIZE)[list(vertices)]


NEAR = near_vertices(TEMPLATE, RADIUS)


def test_near_vertices_of_a_plane_are_those_in_a_circle():
    mesh = lattice(40, 60)
    x, radius = mesh.vertices, RADIUS * np.sqrt(mesh.area)
    expected = np.linalg.norm(x[:, None] - x, axis=2) <= radius
    assert expected.sum(axis=1).max() == 19  # two rings
    np.testing.assert_array_equal(near_vertices(mesh, RADIUS).toarray(), expected)


def test_near_vertices_do_not_cross_a_gap():
    """Two sheets above each other, closer than RADIUS and joined along one side."""
    rows, columns = 40, 8
    sheet = lattice(rows, columns)
    fold = np.repeat(np.arange(rows), columns)
    x = sheet.vertices.copy()
    y = np.where(fold < rows // 2, fold, rows - 1 - fold)
    x[:, 0] -= 0.5 * fold
    x[:, 1], x[:, 2] = y, 0.1 * (fold >= rows // 2)
    near = near_vertices(Mesh(x, sheet.faces), RADIUS).toarray()
    one, above = 0, (rows - 1) * columns
    straight = np.linalg.norm(x[one] - x[above]) / np.sqrt(Mesh(x, sheet.faces).area)
    assert straight < RADIUS and not near[one, above] and near[one, one]


def test_a_point_between_vertices_is_their_mean_by_probability():
    inside, beside, far = SIZE // 2, SIZE // 2 + 1, 0
    probabilities = 0.5 * one_hot(inside) + 0.3 * one_hot(beside) + 0.2 * one_hot(far)
    found = distributions(np.concatenate([probabilities, one_hot(far), probabilities]))
    x = TEMPLATE.vertices
    points = soft_points(found, np.array([inside, far, -1]), NEAR, x)
    np.testing.assert_allclose(points[0], (5 * x[inside] + 3 * x[beside]) / 8, rtol=1e-6)
    np.testing.assert_allclose(points[1], x[far], rtol=1e-6, atol=1e-9)
    assert np.isnan(points[2]).all()


def test_a_temperature_does_not_sharpen_points():
    """It calibrates the probabilities of single vertices."""
    inside, beside = SIZE // 2, SIZE // 2 + 1
    found = distributions(0.6 * one_hot(inside) + 0.4 * one_hot(beside))
    sharper = found._replace(weight=found.weight / 0.5, bias=found.bias / 0.5, temperature=0.5)
    assert sharper.rows(np.array([0]))[0, inside] == pytest.approx(0.36 / 0.52)
    labels = np.array([inside])
    points = (soft_points(each, labels, NEAR, TEMPLATE.vertices) for each in (found, sharper))
    np.testing.assert_allclose(next(points), next(points), rtol=1e-9)


def test_a_label_that_the_network_rules_out_stays_at_its_vertex():
    found = distributions(one_hot(0))
    points = soft_points(found, np.array([SIZE // 2]), NEAR, TEMPLATE.vertices)
    np.testing.assert_array_equal(points, TEMPLATE.vertices[[SIZE // 2]])


def test_a_certain_match_has_confidence_1_and_a_contradiction_0():
    inside, beside, far = SIZE // 2, SIZE // 2 + 1, 0
    source = distributions(one_hot(inside, inside, inside))
    target = distributions(one_hot(inside, beside, far))
    found = map_confidence(source, target, np.arange(3), NEAR)
    np.testing.assert_allclose(found, [1, 1, 0], atol=1e-6)


def test_left_or_right_on_one_side_or_on_both():
    left, right = 0, SIZE - 1
    half = (one_hot(left) + one_hot(right)) / 2
    certain = distributions(one_hot(left))
    match = np.zeros(1, dtype=int)
    for source, target, expected in (
        (distributions(half), certain, 0.5),
        (certain, distributions(half), 0.5),
        (distributions(half), distributions(half), 0.5),
    ):
        found = map_confidence(source, target, match, NEAR)
        np.testing.assert_allclose(found, [expected], atol=1e-6)
    # the labels alone do not show that the other side is in doubt
    np.testing.assert_allclose(near_confidence(certain, np.array([left]), NEAR), [1], atol=1e-6)


def test_confidences_are_those_of_the_formula():
    """Many vertices share rows; some have none."""
    rng = np.random.default_rng(0)
    p, q = (rng.dirichlet(np.full(SIZE, 0.01), 20) for _ in range(2))
    rows, others = rng.integers(20, size=1500), rng.integers(20, size=900)
    rows[7] = others[3] = -1
    match = rng.integers(900, size=1500)
    match[match == 3] = 4
    match[[5, 7]] = -1
    source, target = distributions(p, rows), distributions(q, others)
    expected = np.einsum("vi,ij,vj->v", p[rows], NEAR.toarray(), q[others[match]], optimize=True)
    found = map_confidence(source, target, match, NEAR)
    np.testing.assert_allclose(found, np.where(match >= 0, expected, 0), atol=1e-6)
    labels = rng.integers(SIZE, size=1500)
    labels[5] = -1
    expected = (NEAR.toarray()[labels] * p[rows]).sum(axis=1)
    expected[[5, 7]] = 0
    np.testing.assert_allclose(near_confidence(source, labels, NEAR), expected, atol=1e-6)


def test_of_a_vertex_whose_side_is_known_the_other_side_has_no_probability():
    rng = np.random.default_rng(0)
    p = rng.dirichlet(np.ones(SIZE), 3)
    sides = rng.integers(-1, 2, SIZE).astype(np.int8)
    plain = distributions(p, np.arange(3))
    known = plain._replace(side=np.array([1, 0, -1]), sides=sides)
    found = known.rows(np.array([2, 0, 1]))
    for row, (vertex, side) in enumerate([(2, -1), (0, 1)]):
        kept = np.where(sides != -side, p[vertex], 0)
        np.testing.assert_allclose(found[row], kept / kept.sum(), atol=1e-6)
    np.testing.assert_allclose(found[2], p[1], atol=1e-6)


@pytest.mark.parametrize("smooth", [False, True])
def test_matches_of_bodies_with_high_confidence_are_right(smooth):
    """Of bodies with noise of 5 mm, some of whose matches are wrong."""
    bodies, rng, scans = Bodies(1500), np.random.default_rng(0), []
    for name in (bodies.names["test"][3], bodies.names["test"][16]):
        mesh = bodies.load(name).mesh
        noise = rng.normal(scale=0.005, size=mesh.vertices.shape)
        scans.append(scan(mesh.vertices + noise, mesh.faces, name))
    match = Matcher.load(smooth=smooth, ensemble=False).match(*scans)
    distance = np.linalg.norm(
        bodies.template.vertices[match.target] - bodies.template.vertices, axis=1
    )
    right = distance <= RADIUS * np.sqrt(bodies.template.area)  # vertex i belongs to vertex i
    sure, unsure = match.confidence > 0.8, match.confidence < 0.2
    assert sure.mean() > 0.5 and right[sure].mean() > 0.97
    assert right[match.confidence < 0.5].mean() < right[sure].mean()
    if smooth:  # the label's own probability is low where ZoomOut moved it
        labels = match.source_labels
        assert (labels.confidence < 0.2).mean() > 2 * unsure.mean()
        assert (labels.near_confidence >= labels.confidence - 1e-5).all()
