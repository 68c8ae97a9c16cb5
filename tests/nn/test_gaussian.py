"""Gaussian mixture convolutions: what one Gaussian picks, the wrap of angles, gradients."""

from __future__ import annotations

import math

import pytest
import torch

from meshspiral.nn.gaussian import Disks, GaussianMixtureConv
from meshspiral.nn.networks import MoNet


def disks(vertices: int = 20, most: int = 7) -> Disks:
    """Random disks, each with at least two vertices."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.stack(
        [torch.randperm(vertices, generator=generator)[:most] for _ in range(vertices)]
    )
    rows[:, 0] = torch.arange(vertices)
    ends = torch.randint(2, most + 1, (vertices, 1), generator=generator)
    padding = torch.arange(most) >= ends
    polar = torch.rand(2, vertices, most, generator=generator, dtype=torch.float64)
    distances, angles = polar[0], (2 * polar[1] - 1) * math.pi
    distances[:, 0] = angles[:, 0] = 0.0
    return Disks(
        rows.masked_fill(padding, -1).int(),
        distances.masked_fill(padding, 0.0),
        angles.masked_fill(padding, 0.0),
    )


def one_gaussian(distance: float, angle: float, *widths: float) -> GaussianMixtureConv:
    layer = GaussianMixtureConv(3, 3, 1, 1).double()
    with torch.no_grad():
        layer.mean_distance.fill_(distance)
        layer.mean_angle.fill_(angle)
        layer.log_width.copy_(torch.log(torch.tensor(widths)))
        layer.linear.weight.copy_(torch.eye(3))
    return layer


def test_one_narrow_gaussian_picks_one_vertex():
    around, features = disks(), torch.randn(20, 3, dtype=torch.float64)
    v, k = 4, 1
    place = float(around.distances[v, k]), float(around.angles[v, k])
    found = one_gaussian(*place, 1e-3, 1e-3)(features, around)
    torch.testing.assert_close(found[v], features[around.vertices[v, k]], atol=1e-9, rtol=0)


def test_wide_gaussians_give_the_mean_of_the_disk():
    around, features = disks(), torch.randn(20, 3, dtype=torch.float64)
    found = one_gaussian(0.5, 0.0, 1e3, 1e3)(features, around)
    for v, row in enumerate(around.vertices.long()):
        expected = features[row[row >= 0]].mean(0)
        torch.testing.assert_close(found[v], expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("turns", [-2, -1, 1])
def test_angles_wrap_at_pi(turns):
    around = disks()
    near_pi = one_gaussian(0.5, math.pi - 0.01, 0.3, 0.1).weights(around)
    wrapped = one_gaussian(0.5, math.pi - 0.01 + 2 * math.pi * turns, 0.3, 0.1).weights(around)
    torch.testing.assert_close(wrapped, near_pi, atol=1e-9, rtol=0)
    two = Disks(
        torch.tensor([[0, 1, 2]]),
        torch.tensor([[0.0, 0.5, 0.5]]),
        torch.tensor([[0.0, -math.pi + 0.01, math.pi - 0.03]]),
    )
    weights = one_gaussian(0.5, math.pi - 0.01, 0.05, 0.1).weights(two)[0, 0]
    torch.testing.assert_close(weights[1], weights[2])  # both are 0.02 away


def test_the_centre_lies_in_every_direction():
    around = disks()
    a, b = (one_gaussian(0.0, angle, 0.1, 0.1).weights(around)[:, 0, 0] for angle in (0.0, 2.0))
    assert a.min() > 0.3 and b.min() > 0.3


def test_weights_sum_to_1_and_padding_has_none():
    around = disks()
    weights = GaussianMixtureConv(3, 4, 3, 5).double().weights(around)
    assert weights.shape == (20, 15, 7)
    torch.testing.assert_close(weights.sum(2), torch.ones(20, 15, dtype=torch.float64))
    assert not weights.mT[around.vertices < 0].any()


def test_gaussians_begin_on_a_polar_grid():
    layer = GaussianMixtureConv(3, 4, 2, 4)
    torch.testing.assert_close(layer.mean_distance, torch.tensor([0.5] * 4 + [1.0] * 4))
    quarter = torch.arange(4) * math.pi / 2
    torch.testing.assert_close(layer.mean_angle, quarter.repeat(2))
    torch.testing.assert_close(layer.log_width.exp()[0], torch.tensor([0.5, math.pi / 2]))


def test_renumbering_vertices_renumbers_the_output():
    around, features = disks(), torch.randn(20, 3, dtype=torch.float64)
    layer, order = GaussianMixtureConv(3, 4, 2, 3).double(), torch.randperm(20)
    inverse = torch.argsort(order).int()
    rows = around.vertices[order]
    renumbered = torch.where(rows < 0, rows, inverse[rows.long().clamp(min=0)])
    other = Disks(renumbered, around.distances[order], around.angles[order])
    expected = layer(features, around)[order]
    torch.testing.assert_close(layer(features[order], other), expected)
    shuffled = torch.randperm(7)  # the order within a disk does not matter either
    mixed = Disks(*(x[:, shuffled] for x in around))
    torch.testing.assert_close(layer(features, mixed), layer(features, around))


def test_gradients_equal_finite_differences():
    around = disks(8, 5)
    layer = GaussianMixtureConv(2, 3, 2, 2).double()
    features = torch.randn(8, 2, dtype=torch.float64, requires_grad=True)
    names, parameters = zip(*layer.named_parameters(), strict=True)

    def run(features, *parameters):
        values = dict(zip(names, parameters, strict=True))
        return torch.func.functional_call(layer, values, (features, around))

    assert torch.autograd.gradcheck(run, (features, *parameters))


def test_chunks_make_no_difference(monkeypatch):
    around, features = disks(), torch.randn(20, 3, dtype=torch.float64, requires_grad=True)
    layer = GaussianMixtureConv(3, 4, 2, 3).double()
    results = []
    for rows in (64, 6):
        monkeypatch.setattr("meshspiral.nn.gaussian.CACHED_ROWS", rows)
        out = layer(features, around)
        results.append(
            (out, *torch.autograd.grad(out.square().sum(), [features, *layer.parameters()]))
        )
    for one, two in zip(*results, strict=True):
        torch.testing.assert_close(one, two)


def test_under_autocast_it_stays_near():
    around, features = disks(), torch.randn(20, 10)
    net = MoNet(10, 9, (5, 6, 7), 2, 4).eval()
    around = Disks(around.vertices, around.distances.float(), around.angles.float())
    expected = net(features, around)
    with torch.autocast("cpu", torch.bfloat16):
        found = net(features, around)
    torch.testing.assert_close(found.float(), expected, atol=0.05, rtol=0.05)
