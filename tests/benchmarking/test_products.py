"""The products of a step are those that it computes, by closed forms."""

import pytest
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from meshspiral.benchmarking.inputs import network_of, torus_batch
from meshspiral.benchmarking.products import Product, ProductRecorder, replay
from meshspiral.benchmarking.steps import training_loss, training_step
from meshspiral.data.tensors import draw
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.nn.networks.three_layers import LAST, LIFTED
from tests.helpers import composed

V, N, CLASSES, CHANNELS = 90, 5, 33, [24, 25, 26]
IN = 64  # channels of SHOT with one bin


def recorded(action):
    with ProductRecorder() as recorder:
        action()
    return recorder


def loss_of(model):
    """The forward pass of a small network on a torus."""
    channels = f"model.channels=[{','.join(map(str, CHANNELS))}]"
    config = composed([f"model={model}", channels, f"seq_len={N}", "data.shot.bins=1"])
    batch = draw(Neighbourhood.of(config.neighbourhood), torus_batch(config, V, CLASSES), 0)
    net = network_of(config, CLASSES)
    return net, lambda: training_loss(net, batch)


def linear(rows, inner, columns, products=3):
    """Multiplications and additions of a linear layer: forward, and both gradients."""
    return 2 * products * rows * inner * columns


def fcs(inner, outer):
    return linear(V, N * inner, outer)


def lstm(inner, outer):
    """The input of each vertex once; the hidden state in all steps but the first."""
    return linear(V, inner, 4 * outer) + linear((N - 1) * V, outer, 4 * outer)


def gcnn3(inner, outer, rings=5, rays=16):
    """Per pair of frequencies one complex product; Fourier transforms are products too."""
    width, pairs = rings * inner, rays // 2
    transforms = linear(rays, rays, V * width, 2) + linear(rays, rays, outer * width, 2)
    back = linear(rays, rays, V * outer, 1)
    return pairs * linear(V, 2 * width, 2 * outer) + transforms + back


@pytest.mark.parametrize("layer", [fcs, lstm, gcnn3])
def test_a_step_of_each_network_has_the_operations_of_the_closed_form(layer):
    _, loss = loss_of(layer.__name__)
    sizes = [LIFTED, *CHANNELS]
    expected = linear(V, IN, LIFTED, 2)  # descriptors have no gradient
    expected += sum(layer(*pair) for pair in zip(sizes, CHANNELS, strict=False))
    expected += linear(V, CHANNELS[-1], LAST) + linear(V, LAST, CLASSES)
    assert recorded(lambda: loss().backward()).operations == expected


class Convolutions(nn.Module):
    """A layer as a user might write it, on sequences [V, N, 6]."""

    def __init__(self):
        super().__init__()
        self.conv = nn.Conv1d(6, 8, 3, padding=1, groups=2)
        self.back = nn.ConvTranspose1d(8, 4, 5, stride=2, groups=2)

    def forward(self, x):
        return self.back(self.conv(x.transpose(1, 2))).mean(dim=2)


def test_convolutions_are_recorded_as_their_products():
    x = torch.randn(V, N, 6, requires_grad=True)
    layer = Convolutions()
    dtype = torch.float32
    forward = Product(2, 4, 9, V * N, dtype)  # 2 groups, 4 of 8 channels, 3 channels x 3
    transposed = Product(2, 10, 4, V * N, dtype)  # 2 channels x 5, 4 of 8 channels
    assert recorded(lambda: layer(x)).products == {forward: 1, transposed: 1}
    found = recorded(lambda: layer(x).sum().backward()).products
    assert found == {
        forward: 1,
        Product(2, 9, 4, V * N, dtype): 1,  # by the input
        Product(2, 4, V * N, 9, dtype): 1,  # by the weight
        transposed: 1,
        Product(2, 4, 10, V * N, dtype): 1,
        Product(2, 4, V * N, 10, dtype): 1,
    }
    # without a gradient by the input there are two products fewer
    frozen = recorded(lambda: layer.conv(x.detach().transpose(1, 2)).sum().backward())
    assert sum(frozen.products.values()) == 2


@pytest.mark.parametrize("dimensions", [1, 2, 3])
def test_convolutions_have_the_operations_that_pytorch_counts(dimensions):
    conv = getattr(nn, f"Conv{dimensions}d")(4, 6, 3, stride=2, padding=1, dilation=2)
    x = torch.randn(2, 4, *[9, 8, 7][:dimensions], requires_grad=True)
    with FlopCounterMode(display=False) as counted:
        conv(x).sum().backward()
    assert recorded(lambda: conv(x).sum().backward()).operations == counted.get_total_flops()


def test_every_variant_of_a_product_is_recorded_once():
    a, b, batch = torch.randn(3, 4), torch.randn(4, 5), torch.randn(7, 3, 4)
    out, sums = torch.empty(3, 5), torch.zeros(7, 3, 5)

    def action():
        torch.mm(a, b), torch.mm(a, b, out=out), torch.addmm(out, a, b), out.addmm_(a, b)
        torch.addmm(out, a, b, out=torch.empty(3, 5))
        torch.bmm(batch, b.expand(7, 4, 5)), sums.baddbmm_(batch, b.expand(7, 4, 5))
        torch.baddbmm(sums, batch, b.expand(7, 4, 5))

    one, seven = Product(1, 3, 4, 5, torch.float32), Product(7, 3, 4, 5, torch.float32)
    assert recorded(action).products == {one: 5, seven: 3}
    assert one.operations == 120 and seven.operations == 840


def test_products_are_those_of_autocast():
    net, loss = loss_of("fcs")
    found = recorded(training_step(net, loss, "bf16-mixed")).products
    assert {product.dtype for product in found} == {torch.bfloat16}


@pytest.mark.parametrize("model", ["fcs", "lstm", "gcnn3"])
def test_a_replay_computes_the_products_that_were_recorded(model):
    net, loss = loss_of(model)
    found = recorded(training_step(net, loss))
    again = recorded(replay(found.products, "cpu"))
    assert again.products == found.products and again.operations > 0
