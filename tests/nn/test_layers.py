"""The spiral layers equal the PyTorch operators that they implement."""

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional as F

from meshspiral.nn import layers, recurrence
from meshspiral.nn.layers import SpiralLinear, SpiralLSTM, metric_features
from meshspiral.nn.networks.conv import SpiralConv


def sequences(vertices, length, padded, seed=0):
    """Random spirals, int64 [vertices, length]; if padded, their lengths include 1 and `length`."""
    rng = torch.Generator().manual_seed(seed)
    shift = torch.stack(
        [1 + torch.randperm(vertices - 1, generator=rng)[: length - 1] for _ in range(vertices)]
    )
    centre = torch.arange(vertices)[:, None]
    spirals = torch.cat([centre, (centre + shift) % vertices], dim=1)
    if padded:
        ends = torch.randint(1, length + 1, (vertices,), generator=rng)
        ends[:2] = torch.tensor([1, length])
        spirals[torch.arange(length) >= ends[:, None]] = -1
    return spirals


def reference_metric(vertices, spirals, unit):
    """The definition of `metric_features`, element by element, with arccos."""
    out = np.zeros((*spirals.shape, 2))
    for v, spiral in enumerate(spirals):
        a = vertices[spiral[0]]
        for i, c in enumerate(spiral):
            if c < 0:
                continue
            out[v, i, 0] = np.linalg.norm(vertices[c] - a) / unit
            if i >= 2:
                b, c = vertices[spiral[i - 1]] - a, vertices[c] - a
                cosine = b @ c / np.linalg.norm(b) / np.linalg.norm(c)
                out[v, i, 1] = np.arccos(np.clip(cosine, -1, 1))
    return out


def test_metric_features_are_distance_and_angle():
    vertices = torch.randn(12, 3, dtype=torch.float64)
    spirals = sequences(12, 7, padded=True)
    features = metric_features(vertices, spirals, 0.7)
    expected = reference_metric(vertices.numpy(), spirals.numpy(), 0.7)
    np.testing.assert_allclose(features, expected, atol=1e-10)


def test_metric_features_are_invariant_to_translation_rotation_and_scale():
    vertices = torch.randn(20, 3, dtype=torch.float64)
    spirals = sequences(20, 9, padded=False)
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))
    moved = 1000 * vertices @ rotation + 5
    torch.testing.assert_close(
        metric_features(vertices, spirals, 0.3), metric_features(moved, spirals, 300.0)
    )


def test_metric_features_of_a_right_angle():
    vertices = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 4, 0]])
    features = metric_features(vertices, torch.tensor([[0, 1, 2, 3]]), 2.0)
    expected = [[[0, 0], [1, 0], [1, np.pi / 2], [2, 0]]]
    torch.testing.assert_close(features, torch.tensor(expected, dtype=torch.float32))


def test_coincident_vertices_have_distance_and_angle_zero():
    vertices = torch.zeros(4, 3)
    features = metric_features(vertices, torch.tensor([[0, 1, 2, 3]]), 1.0)
    assert torch.equal(features, torch.zeros(1, 4, 2))


def gather(features, spirals):
    """features[spirals], with zeros at padding."""
    return features[spirals] * (spirals >= 0)[..., None]


@pytest.mark.parametrize("metric", [False, True])
@pytest.mark.parametrize("padded", [False, True])
def test_spiral_linear_is_one_linear_map_of_the_sequence(metric, padded):
    layer = SpiralLinear(5, 4, 6, metric).double()
    features = torch.randn(11, 5, dtype=torch.float64)
    spirals = sequences(11, 6, padded)
    extra = torch.randn(11, 6, 2, dtype=torch.float64) if metric else None
    out = layer(features, spirals, extra)
    for v in range(11):
        expected = layer.linear.bias.clone()
        for i, c in enumerate(spirals[v].tolist()):
            if c >= 0:
                expected += layer.linear.weight[:, 5 * i : 5 * i + 5] @ features[c]
            if metric:
                expected += layer.metric.weight[:, 2 * i : 2 * i + 2] @ extra[v, i]
        torch.testing.assert_close(out[v], expected)


@pytest.mark.parametrize("rows", [1, 4, 1024])
@pytest.mark.parametrize("padded", [False, True])
def test_spiral_linear_has_the_gradients_of_a_linear_map(padded, rows, monkeypatch):
    monkeypatch.setattr(layers, "ROWS", rows)
    layer = SpiralLinear(5, 4, 6).double()
    features = torch.randn(11, 5, dtype=torch.float64, requires_grad=True)
    spirals = sequences(11, 6, padded)
    out, expected = layer(features, spirals), layer.linear(gather(features, spirals).flatten(1))
    torch.testing.assert_close(out, expected, rtol=0, atol=1e-12)
    upstream, inputs = torch.randn_like(out), [features, layer.linear.weight, layer.linear.bias]
    actual, reference = (torch.autograd.grad(x, inputs, upstream) for x in (out, expected))
    for a, b in zip(actual, reference, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-12)


def test_spiral_linear_under_autocast_multiplies_in_bf16_and_sums_in_float32():
    layer = SpiralLinear(8, 16, 6)
    features, spirals = torch.randn(3000, 8, requires_grad=True), sequences(3000, 6, padded=True)
    inputs = [features, layer.linear.weight, layer.linear.bias]
    exact = layer(features, spirals)
    with torch.autocast("cpu", torch.bfloat16):
        out = layer(features, spirals)
    assert out.dtype == torch.bfloat16
    torch.testing.assert_close(out.float(), exact, rtol=0, atol=0.05)
    actual, reference = (torch.autograd.grad(x.float().sum(), inputs) for x in (out, exact))
    for a, b in zip(actual, reference, strict=True):
        assert a.dtype == torch.float32
        torch.testing.assert_close(a, b, rtol=0, atol=0.01 * float(b.abs().max()))
    assert (actual[2] == 3000).all()  # a sum in bf16 would end near 256


def test_spiral_linear_rejects_another_length():
    with pytest.raises(ValueError, match="length 6, got 5"):
        SpiralLinear(5, 4, 6)(torch.randn(9, 5), sequences(9, 5, False))


def reference_lstm(layer: SpiralLSTM, metric: bool) -> nn.LSTM:
    """A torch.nn.LSTM with the weights of the layer; its second bias is 0."""
    hidden = layer.hidden.in_features
    lstm = nn.LSTM(layer.input.in_features + 2 * metric, hidden, batch_first=True).double()
    weight = [layer.input.weight, layer.metric.weight] if metric else [layer.input.weight]
    with torch.no_grad():
        lstm.weight_ih_l0.copy_(torch.cat(weight, dim=1))
        lstm.weight_hh_l0.copy_(layer.hidden.weight)
        lstm.bias_ih_l0.copy_(layer.input.bias)
        lstm.bias_hh_l0.zero_()
    return lstm


@pytest.mark.parametrize("metric", [False, True])
@pytest.mark.parametrize("padded", [False, True])
def test_spiral_lstm_is_the_last_output_of_an_lstm_before_padding(metric, padded):
    layer = SpiralLSTM(5, 7, metric).double()
    features = torch.randn(13, 5, dtype=torch.float64, requires_grad=True)
    spirals = sequences(13, 6, padded)
    extra = torch.randn(13, 6, 2, dtype=torch.float64) if metric else None
    out = layer(features, spirals, extra)

    x = gather(features, spirals)
    if metric:
        x = torch.cat([x, extra], dim=2)
    lengths = (spirals >= 0).sum(1)
    packed = nn.utils.rnn.pack_padded_sequence(x, lengths, batch_first=True, enforce_sorted=False)
    lstm = reference_lstm(layer, metric)
    expected = lstm(packed)[1][0][0]
    torch.testing.assert_close(out, expected, rtol=0, atol=1e-12)

    upstream = torch.randn_like(out)
    ours = [features, layer.hidden.weight, layer.input.bias, layer.input.weight]
    theirs = [features, lstm.weight_hh_l0, lstm.bias_ih_l0, lstm.weight_ih_l0]
    if metric:
        ours.append(layer.metric.weight)
    *grad, last = torch.autograd.grad(out, ours, upstream)
    grad.append(torch.cat([grad.pop(), last], dim=1) if metric else last)
    same = torch.autograd.grad(expected, theirs, upstream)
    for a, b in zip(grad, same, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-11)


def output_and_gradients(layer: SpiralLSTM, *inputs) -> list[torch.Tensor]:
    """The output of a layer, and the gradients of its parameters for the sum of squares."""
    layer.zero_grad()
    out = layer(*inputs)
    out.square().sum().backward()
    return [out.detach(), *(p.grad.clone() for p in layer.parameters())]


@pytest.mark.parametrize("rows", [1, 5, 13, 512])
def test_the_chunk_size_does_not_change_an_lstm(rows, monkeypatch):
    layer = SpiralLSTM(5, 7, metric=True).double()
    features, spirals = torch.randn(13, 5, dtype=torch.float64), sequences(13, 6, padded=True)
    extra = torch.randn(13, 6, 2, dtype=torch.float64)

    whole = output_and_gradients(layer, features, spirals, extra)
    monkeypatch.setattr(recurrence, "ROWS", rows)
    for a, b in zip(output_and_gradients(layer, features, spirals, extra), whole, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-12)
    with torch.no_grad():  # uses buffers for two steps only
        torch.testing.assert_close(layer(features, spirals, extra), whole[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("metric", [False, True])
def test_an_lstm_that_computes_its_steps_again_has_the_same_gradient(metric, monkeypatch):
    torch.manual_seed(0)
    layer = SpiralLSTM(5, 7, metric).double()
    features, spirals = torch.randn(19, 5, dtype=torch.float64), sequences(19, 6, padded=True)
    extra = torch.randn(19, 6, 2, dtype=torch.float64) if metric else None
    chunks, original = [], recurrence._forward_steps

    def noted(*arguments):
        chunks.append((len(arguments[3]), arguments[-1]))
        return original(*arguments)

    monkeypatch.setattr(recurrence, "_forward_steps", noted)

    kept = output_and_gradients(layer, features, spirals, extra)
    assert chunks == [(19, True)]
    chunks.clear()
    layer.recompute = True
    for a, b in zip(output_and_gradients(layer, features, spirals, extra), kept, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-12)
    parts = [3, 3, 3, 3, 3, 3, 1]  # an eighth, rounded up; each without its steps, later with them
    assert chunks == [*((n, False) for n in parts), *((n, True) for n in reversed(parts))]


def test_backward_of_an_lstm_runs_only_once():
    layer = SpiralLSTM(3, 4)
    out = layer(torch.randn(9, 3), sequences(9, 5, padded=False)).sum()
    out.backward(retain_graph=True)
    with pytest.raises(RuntimeError, match="can run only once"):
        out.backward()


def test_an_lstm_under_autocast_multiplies_in_bf16_and_has_float32_states():
    layer = SpiralLSTM(8, 16)
    features, spirals = torch.randn(40, 8, requires_grad=True), sequences(40, 20, padded=True)
    exact = layer(features, spirals)
    with torch.autocast("cpu", torch.bfloat16):
        out = layer(features.bfloat16(), spirals)
    assert out.dtype == torch.float32 and not torch.equal(out, exact)
    torch.testing.assert_close(out, exact, rtol=0, atol=0.03)
    grads = [
        torch.autograd.grad(x.square().sum(), [features, layer.hidden.weight]) for x in (out, exact)
    ]
    for a, b in zip(*grads, strict=True):
        assert a.dtype == torch.float32
        torch.testing.assert_close(a, b, rtol=0, atol=0.03 * float(b.abs().max()))


def test_more_padding_does_not_change_an_lstm():
    layer = SpiralLSTM(3, 4)
    features, spirals = torch.randn(9, 3), sequences(9, 5, padded=True)
    longer = F.pad(spirals, (0, 4), value=-1)
    torch.testing.assert_close(layer(features, spirals), layer(features, longer))


@pytest.mark.parametrize("taps", [1, 3, 5])
@pytest.mark.parametrize("metric", [False, True])
def test_the_convolution_equals_torchs_along_each_spiral(taps, metric):
    torch.manual_seed(0)
    layer = SpiralConv(3, 4, 6, hidden=5, taps=taps, metric=metric).double()
    torch.nn.init.normal_(layer.position)
    x, information = torch.randn(9, 3).double(), torch.rand(9, 6, 2).double()
    spirals = torch.randint(0, 9, (9, 6))
    spirals[2, 4:] = spirals[5, 1:] = -1
    ended = spirals < 0
    sequences = x[spirals.clamp(min=0)].masked_fill(ended[..., None], 0.0).transpose(1, 2)
    kernel = layer.taps_in.weight.view(taps, 5, 3).permute(1, 2, 0)
    hidden = torch.nn.functional.conv1d(sequences, kernel, padding=taps // 2).transpose(1, 2)
    hidden = hidden + layer.position
    if metric:
        hidden = hidden + layer.metric(information)
    hidden = torch.relu(hidden).masked_fill(ended[..., None], 0.0)
    expected = layer.out((hidden * layer.sum).sum(1))
    torch.testing.assert_close(layer(x, spirals, information if metric else None), expected)


def test_the_convolution_refuses_another_length():
    with pytest.raises(ValueError, match="spirals must have length 6, got 5"):
        SpiralConv(3, 4, 6, hidden=5)(torch.rand(9, 3), torch.zeros(9, 5, dtype=torch.int64))
