"""Geodesic errors of correspondences, and their curve."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from meshspiral.evaluation.metrics import THRESHOLDS, CorrespondenceError, geodesic_errors


def correspondence_curve(errors: np.ndarray) -> list[float]:
    """The share of errors up to each threshold, itself included (Kim et al. 2011)."""
    return [(errors <= threshold).mean() for threshold in THRESHOLDS]


def test_the_curve_is_inclusive_and_starts_at_the_exact_match_rate():
    errors = np.array([0, 0, 0.01, 0.05, 0.3])
    metric = CorrespondenceError()
    metric.update(errors, errors == 0)
    curve = dict(zip(THRESHOLDS.tolist(), metric.compute()["curve"].tolist(), strict=True))
    assert [curve[threshold] for threshold in (0.0, 0.01, 0.05, 0.2)] == [0.4, 0.6, 0.8, 0.8]


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
