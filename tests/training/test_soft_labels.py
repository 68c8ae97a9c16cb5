"""Training with soft labels: the kernel around the label, or around the point within a face."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from meshspiral.nn.loss import Points, SoftLabels, linear_cross_entropy
from meshspiral.training import module
from tests.helpers import run, same_weights

REMESH = ["data/remesh=mixed", "data.remesh.vertices=120"]


@pytest.mark.parametrize("remesh", [[], REMESH], ids=["vertices", "points"])
def test_soft_labels_reach_the_loss(toy_overrides, tmp_path, monkeypatch, remesh):
    read = []

    def loss(x, weight, bias, labels, soft_labels=None):
        read.append((labels, soft_labels))
        return linear_cross_entropy(x, weight, bias, labels, soft_labels)

    monkeypatch.setattr(module, "linear_cross_entropy", loss)
    words = [*toy_overrides, *remesh, "optim.epochs=1"]
    run(tmp_path / "soft", [*words, "optim.soft_labels=0.1"])
    for labels, kernel in read:
        assert isinstance(labels, Points if remesh else torch.Tensor)
        assert isinstance(kernel, SoftLabels)
        np.testing.assert_allclose(kernel.weights.sum(1), 1, rtol=1e-5)
        assert (kernel.weights > 0).sum(1).float().mean() > 3
    read.clear()
    run(tmp_path / "hard", words)
    assert all(kernel is None for _, kernel in read)
    assert not same_weights(tmp_path / "soft", tmp_path / "hard")
    run(tmp_path / "points", [*words, "optim.soft_labels=0"])
    assert same_weights(tmp_path / "points", tmp_path / "hard") == (not remesh)
