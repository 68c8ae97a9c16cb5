"""Distances, errors and curves equal closed forms, and pool over meshes."""

import numpy as np
import pytest
import torch

from meshspiral.data.cache import Cache
from meshspiral.data.reference import BLOCK, ReferenceDistances
from meshspiral.evaluation.metrics import (
    THRESHOLDS,
    CorrespondenceError,
    correspondence_curve,
    geodesic_errors,
)
from meshspiral.geometry.geodesics import GeodesicSolver, diameter
from meshspiral.geometry.mesh import Mesh, MeshError
from tests.meshes import lattice, union


def icosphere(subdivisions=3):
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Mesh(sphere.vertices, sphere.faces)


def test_geodesic_distances_on_a_sphere_are_great_circles():
    mesh = icosphere()
    row = GeodesicSolver(mesh).row(5)
    exact = np.arccos(np.clip(mesh.vertices @ mesh.vertices[5], -1, 1))
    assert row[5] == 0 and (row >= 0).all()
    assert np.abs(row - exact).mean() < 0.02 * np.pi


def test_the_diameter_of_a_sphere_is_half_a_great_circle():
    assert diameter(icosphere()) == pytest.approx(np.pi, rel=0.02)


def test_distances_between_components_are_infinite():
    mesh = union(icosphere(1), icosphere(1))
    row = GeodesicSolver(mesh).row(0)
    assert np.isfinite(row[:42]).all() and np.isinf(row[42:]).all()


def test_distances_from_a_vertex_without_a_face_are_infinite():
    sphere = icosphere(1)
    for lone in (0, 7, 42):
        vertices = np.insert(sphere.vertices, lone, [9, 9, 9], axis=0)
        mesh = Mesh(vertices, sphere.faces + (sphere.faces >= lone))
        solver = GeodesicSolver(mesh)
        row = solver.row(5)
        assert np.isinf(row[lone]) and np.isfinite(np.delete(row, lone)).all()
        assert solver.row(lone)[lone] == 0 and np.isinf(np.delete(solver.row(lone), lone)).all()
        assert diameter(mesh) == pytest.approx(diameter(sphere), rel=0.01)


def test_a_mesh_without_area_is_rejected():
    with pytest.raises(MeshError, match="no surface area"):
        GeodesicSolver(Mesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], "flat"))


@pytest.fixture
def reference(tmp_path):
    return ReferenceDistances(icosphere(), Cache(tmp_path))


def test_reference_distances_are_over_the_square_root_of_the_area(reference):
    mesh = reference.template
    rng = np.random.default_rng(0)
    sources, targets = rng.integers(0, len(mesh.vertices), (2, 200))
    exact = np.arccos(np.clip((mesh.vertices[sources] * mesh.vertices[targets]).sum(1), -1, 1))
    distances = reference(sources, targets)
    np.testing.assert_allclose(distances, exact / np.sqrt(mesh.area), atol=0.03)
    assert reference.diameter == pytest.approx(np.pi / np.sqrt(mesh.area), rel=0.02)
    scaled = ReferenceDistances(Mesh(1000 * mesh.vertices, mesh.faces), reference._cache)
    np.testing.assert_allclose(scaled(sources, targets), distances, rtol=1e-4, atol=1e-6)


def test_only_requested_rows_are_computed_and_they_are_cached(reference, monkeypatch):
    computed = []
    row = GeodesicSolver.row
    monkeypatch.setattr(GeodesicSolver, "row", lambda s, v: computed.append(v) or row(s, v))
    reference(np.array([3, 3]), np.array([3, 9]))
    assert computed == list(range(BLOCK))
    reference(np.array([7]), np.array([1]))
    again = ReferenceDistances(reference.template, reference._cache)
    again(np.array([3]), np.array([9]))
    again(np.array([600]), np.array([600]))  # source and target are equal
    assert len(computed) == BLOCK


def test_the_rows_in_memory_are_bounded(reference, monkeypatch):
    monkeypatch.setattr("meshspiral.data.reference.IN_MEMORY", 1)
    rng = np.random.default_rng(1)
    sources, targets = rng.integers(0, 642, (2, 50))
    bounded = reference(sources, targets)
    assert len(reference._blocks) == 1
    monkeypatch.setattr("meshspiral.data.reference.IN_MEMORY", 2**30)
    np.testing.assert_array_equal(reference(sources, targets), bounded)
    assert len(reference._blocks) == 3


def test_a_pair_on_two_components_counts_as_the_diameter(tmp_path):
    reference = ReferenceDistances(union(icosphere(1), icosphere(1)), Cache(tmp_path))
    assert reference(np.array([0]), np.array([50]))[0] == pytest.approx(reference.diameter)


def test_the_curve_is_inclusive_and_starts_at_the_exact_match_rate():
    errors = np.array([0, 0, 0.01, 0.05, 0.3])
    thresholds = np.array([0, 0.0099, 0.01, 0.05, 0.2])
    assert correspondence_curve(errors, thresholds).tolist() == [0.4, 0.4, 0.6, 0.8, 0.8]
    assert np.isnan(correspondence_curve(np.zeros(0))).all()


def test_reported_radii_are_thresholds_of_the_curve():
    assert {0.0, 0.01, 0.05, 0.1, 0.2} <= set(THRESHOLDS.tolist())


def test_an_error_is_the_distance_from_label_to_prediction():
    table = np.arange(9.0).reshape(3, 3)
    errors = geodesic_errors(np.array([2, 1]), np.array([0, 1]), lambda a, b: table[a, b])
    assert errors.tolist() == [2.0, 4.0]


def test_the_metric_pools_vertices_over_meshes_of_different_size():
    rng = np.random.default_rng(0)
    meshes = [np.where(rng.random(n) < 0.3, 0.0, rng.random(n) * 0.3) for n in (10, 300, 41)]
    metric = CorrespondenceError()
    for errors in meshes:
        metric.update(errors, errors == 0)
    metric.update(np.zeros(0), np.zeros(0, bool))
    values, pooled = metric.compute(), np.concatenate(meshes)
    assert values["exact_match"] == pytest.approx((pooled == 0).mean())
    assert values["geodesic_error"] == pytest.approx(pooled.mean())
    for radius in (0.01, 0.05, 0.10):
        assert values[f"within_{radius:.2f}"] == pytest.approx((pooled <= radius).mean())
    np.testing.assert_allclose(values["curve"], correspondence_curve(pooled))
    assert values["curve"][0] == values["exact_match"]
    metric.reset()
    metric.update(np.array([0.0]), np.array([True]))
    assert metric.compute()["exact_match"] == 1


def test_an_error_of_zero_is_not_an_exact_match():
    """Two template vertices coincide: the error is 0, but the prediction is wrong."""
    metric = CorrespondenceError()
    metric.update(np.array([0.0, 0.0]), np.array([True, False]))
    values = metric.compute()
    assert values["exact_match"] == 0.5 and values["geodesic_error"] == 0


def test_the_states_of_two_processes_are_summed():
    parts = [np.array([0.0, 0.02]), np.array([0.0, 0.06, 0.3])]
    metrics = [CorrespondenceError() for _ in parts]
    for metric, errors in zip(metrics, parts, strict=True):
        metric.update(errors, errors == 0)
    for name, reduce in metrics[0]._reductions.items():
        states = torch.stack([getattr(metric, name) for metric in metrics])
        setattr(metrics[0], name, reduce(states))
    metrics[0]._computed = None
    pooled = np.concatenate(parts)
    np.testing.assert_allclose(metrics[0].compute()["curve"], correspondence_curve(pooled))


def test_geodesic_distances_on_a_plane_are_straight():
    mesh = lattice(12, 12)
    row = GeodesicSolver(mesh).row(0)
    exact = np.linalg.norm(mesh.vertices - mesh.vertices[0], axis=1)
    assert np.abs(row - exact).mean() < 0.05 * exact.max()
    corners = mesh.vertices[[0, -1]]  # the ends of the long diagonal
    assert diameter(mesh) == pytest.approx(np.linalg.norm(corners[1] - corners[0]), rel=0.05)
