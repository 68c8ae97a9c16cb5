"""Every network takes part in everything: training, resuming, matching, bf16, the benchmark."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from meshspiral import Matcher, scan
from meshspiral.benchmarking.steps import training_loss, training_step
from meshspiral.commands import evaluate
from meshspiral.data.descriptors import Features
from meshspiral.data.tensors import draw, mesh_tensors
from meshspiral.experiment.run_folder import METRICS, Stopped
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.nn.networks import Network
from tests.conftest import toy_shapes
from tests.helpers import ROOT, SMALL, composed, run, same_weights, stop_at

MODELS = sorted(path.stem for path in (ROOT / "conf" / "model").glob("*.yaml"))


def words(model: str, toy_overrides: list[str]) -> list[str]:
    """The command line that trains a small network of a kind on the toy data set."""
    rest = [word for word in toy_overrides if not word.startswith("model.channels")]
    return [f"model={model}", *SMALL[model], *rest]


def test_every_network_has_a_small_version():
    assert set(SMALL) == set(MODELS) == set(Network.registered)


@pytest.mark.parametrize("model", MODELS)
def test_it_trains_stops_resumes_to_the_bit_is_tested_again_and_matches(
    cli, model, toy_overrides, tmp_path, monkeypatch
):
    overrides = [*words(model, toy_overrides), "optim.epochs=2"]
    metrics = run(tmp_path / "whole", overrides)
    assert np.isfinite(list(metrics.values())).all()

    code, _, err = cli(f"run={tmp_path / 'whole'}", "shapes=0", program=evaluate.main)
    assert code == 0, err
    again = json.loads((tmp_path / "whole/evaluation/folder" / METRICS).read_text())
    assert again == pytest.approx({key: metrics[key] for key in again}, rel=1e-6)

    go_on = stop_at(monkeypatch, 8)
    with pytest.raises(Stopped):
        run(tmp_path / "cut", overrides)
    go_on()
    run(tmp_path / "cut", overrides)
    assert same_weights(tmp_path / "whole", tmp_path / "cut")

    mesh = toy_shapes()["test/0.ply"]
    labels = Matcher.load(tmp_path / "whole").label(scan(mesh.vertices, mesh.faces, "mesh"))
    assert labels.template.shape == (162,)


@pytest.mark.parametrize("model", MODELS)
def test_a_step_in_bf16_is_near_one_in_float32_and_lowers_the_loss(model, toy_overrides):
    config = composed(words(model, toy_overrides))
    neighbourhood = Neighbourhood.of(config.neighbourhood)
    batch = mesh_tensors(toy_shapes()["train/0.ply"], Features.of(config.data), neighbourhood)
    batch |= {"labels": torch.arange(162), "index": 0}
    batch = draw(neighbourhood, batch, 0)
    torch.manual_seed(0)
    cls = Network.registered[model]
    net = cls.build(config.model, neighbourhood, batch["features"].shape[1], 162).eval()
    expected = training_loss(net, batch)
    with torch.autocast("cpu", torch.bfloat16):
        found = training_loss(net, batch)
    torch.testing.assert_close(found.float(), expected, atol=0.03, rtol=0.03)
    step = training_step(net, lambda: training_loss(net, batch), "bf16-mixed")
    for _ in range(3):
        step()
    assert training_loss(net, batch) < expected
