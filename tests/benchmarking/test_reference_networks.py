"""Each network against its reference: one loss, one gradient."""

import pytest
import torch

from meshspiral.benchmarking import reference
from meshspiral.benchmarking.inputs import network_of, torus_batch
from meshspiral.benchmarking.reference import reference_loss, reference_network
from meshspiral.benchmarking.steps import training_loss
from meshspiral.data.tensors import draw
from meshspiral.neighbourhoods import Neighbourhood
from tests.helpers import ROOT, SMALL, composed
from tests.nn.test_geodesic import as_resampling, patches

MODELS = sorted(path.stem for path in (ROOT / "conf" / "model").glob("*.yaml"))
VERTICES, CLASSES = 60, 21


def in_double(entry):
    if isinstance(entry, dict):
        return {key: in_double(value) for key, value in entry.items()}
    is_float = isinstance(entry, torch.Tensor) and entry.is_floating_point()
    return entry.double() if is_float else entry


def network_and_batch(model, *more):
    """A small network without dropout, in float64, and a batch for it."""
    small = [*SMALL[model], "seq_len=6", "data.shot.bins=1", *more]
    if model != "acnn":  # which has none
        small.append("model.dropout=0")
    config = composed([f"model={model}", *small])
    batch = torus_batch(config, VERTICES, CLASSES)
    batch = draw(Neighbourhood.of(config.neighbourhood), batch, 0)
    torch.manual_seed(0)
    return network_of(config, CLASSES).double(), in_double(batch)


@pytest.mark.parametrize("model", ["conv", "fcs", "lstm"])
def test_losses_with_metric_information_agree(model):
    net, batch = network_and_batch(model, "metric=true")
    ours, theirs = training_loss(net, batch), reference_loss(reference_network(net), batch)
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_losses_and_gradients_agree_to_1e_9(model):
    net, batch = network_and_batch(model)
    copy = reference_network(net)
    ours, theirs = training_loss(net, batch), reference_loss(copy, batch)
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-9)
    ours.backward(), theirs.backward()
    expected = dict(copy.named_parameters())
    shared = {name: p for name, p in net.named_parameters() if name in expected}
    assert {"lift.weight", "head.weight"} <= shared.keys()
    for name, parameter in shared.items():
        assert parameter.grad.abs().max() > 1e-6, name
        torch.testing.assert_close(parameter.grad, expected[name].grad, rtol=0, atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_every_layer_of_the_bundled_networks_has_a_reference(model):
    net, _ = network_and_batch(model)
    copy = reference_network(net)
    layers = [each.blocks if model == "diffusion" else each.layers for each in (net, copy)]
    expected = [reference.REFERENCES[type(layer)] for layer in layers[0]]
    assert [type(layer) for layer in layers[1]] == expected
    pointers = [{p.data_ptr() for p in each.parameters()} for each in (net, copy)]
    assert not pointers[0] & pointers[1]  # the copy has weights of its own


def test_a_layer_without_a_reference_stays(monkeypatch):
    monkeypatch.setattr(reference, "REFERENCES", {})
    net, batch = network_and_batch("fcs")
    copy = reference_network(net)
    assert [type(layer) for layer in copy.layers] == [type(layer) for layer in net.layers]
    torch.testing.assert_close(reference_loss(copy, batch), training_loss(net, batch))


def test_the_reference_of_a_geodesic_convolution_handles_missing_samples():
    net, _ = network_and_batch("gcnn3")
    layer, samples = net.layers[0], as_resampling(*patches(30, empty=0.4))
    x = torch.randn(30, 16, dtype=torch.float64)
    copy = reference.ReferenceGeodesicConv(layer)
    torch.testing.assert_close(copy(x, samples), layer(x, samples), rtol=0, atol=1e-9)
