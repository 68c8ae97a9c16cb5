"""Predictions averaged over a mesh and resampled copies of it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from meshspiral.data.datasets.bodies import Bodies
from meshspiral.matching import matcher as module
from meshspiral.matching.matcher import Matcher, normalize

BODY = normalize(Bodies(1500).load("s9_squat").mesh)


def test_copies_have_other_densities_and_sizes_and_are_carried_back(monkeypatch):
    """With positions in place of embeddings, the mean is where the vertices are."""
    matcher, seen = Matcher.load(), []

    def positions(mesh):
        seen.append((len(mesh.vertices), mesh.size))
        return torch.from_numpy(mesh.vertices)

    monkeypatch.setattr(matcher, "_embed", positions)
    found = matcher._with_copies(BODY, positions(BODY))
    counts = [1500, *(share * matcher._training_size for share, _ in module.COPIES)]
    assert [count for count, _ in seen] == pytest.approx(counts, rel=0.01)
    np.testing.assert_allclose([size for _, size in seen], [1, 0.96, 1, 1.04])
    off = np.linalg.norm(found.numpy() - BODY.vertices, axis=1)
    assert 0 < np.median(off) < 0.003 and off.max() < 0.03

    def far(mesh):
        return torch.from_numpy(mesh.vertices) + 5

    monkeypatch.setattr(matcher, "_embed", far)
    found = matcher._with_copies(BODY, torch.from_numpy(BODY.vertices))
    expected = torch.from_numpy(BODY.vertices) + 15 / 4
    assert (found - expected).abs().median() < 0.003


def test_a_copy_as_dense_as_the_mesh_is_left_out(monkeypatch):
    matcher, given = Matcher.load(), torch.rand(1500, 4)
    monkeypatch.setattr(module, "COPIES", ((1500 / matcher._training_size, 1.0),))
    assert torch.equal(matcher._with_copies(BODY, given), given)


def test_a_network_that_knows_one_tessellation_has_no_ensemble(trained):
    assert not Matcher.load(trained, refine="crf")._ensemble
    assert Matcher.load(trained, ensemble=True)._ensemble


@pytest.mark.parametrize(
    "options, expected",
    [
        ({}, False),
        ({"refine": "crf"}, True),
        ({"refine": "crf", "ensemble": False}, False),
        ({"refine": "crf", "resampled": False}, False),
        ({"ensemble": True}, True),
    ],
)
def test_a_refinement_brings_the_ensemble_along(options, expected, monkeypatch):
    matcher, called = Matcher.load(**options), []
    monkeypatch.setattr(matcher, "_with_copies", lambda mesh, x: called.append(mesh) or x)
    matcher._predict(BODY, lambda stage: None)
    assert bool(called) == expected
