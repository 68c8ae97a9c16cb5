"""The networks as one would first write them, to measure and to test the fast ones against."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from meshspiral.neighbourhoods.base import Batch
from meshspiral.nn.diffusion import LEAST_TIME, DiffusionBlock, SurfaceOperators
from meshspiral.nn.gaussian import Disks, GaussianMixtureConv
from meshspiral.nn.geodesic import GeodesicConv, Resampling
from meshspiral.nn.layers import SpiralLinear, SpiralLSTM
from meshspiral.nn.networks import Network
from meshspiral.nn.networks.conv import SpiralConv


def reference_network(net: Network) -> Network:
    """A copy of a network, with the same weights, in which reference layers replace fast ones.

    A layer whose type has no entry in `REFERENCES` stays as it is; for a network of such layers
    alone, the reference differs in the cross-entropy only.

    Args:
        net: A network whose sequences, if it reads any, are without padding.
    """
    reference = copy.deepcopy(net)
    for name, layer in net.named_modules():
        if type(layer) in REFERENCES:
            reference.set_submodule(name, REFERENCES[type(layer)](layer))
    return reference


def reference_loss(net: Network, batch: Batch) -> Tensor:
    """The cross-entropy of a batch, with all scores in memory at once."""
    return F.cross_entropy(net.head(net.embed_batch(batch)), batch["labels"])


class ReferenceSpiralLinear(nn.Module):
    """`SpiralLinear` on spirals without padding: all of them are gathered at once."""

    def __init__(self, layer: SpiralLinear):
        super().__init__()
        self.linear, self.metric = copy.deepcopy(layer.linear), copy.deepcopy(layer.metric)

    def forward(self, x: Tensor, spirals: Tensor, metric: Tensor | None = None) -> Tensor:
        out = self.linear(x[spirals].flatten(1))
        return out if self.metric is None else out + self.metric(metric.flatten(1))


class ReferenceSpiralLSTM(nn.Module):
    """`SpiralLSTM` on spirals without padding: `torch.nn.LSTM` on the gathered spirals."""

    def __init__(self, layer: SpiralLSTM):
        super().__init__()
        weight = layer.input.weight
        if layer.metric is not None:
            weight = torch.cat([weight, layer.metric.weight], dim=1)
        self.metric = layer.metric is not None
        sizes = weight.shape[1], layer.hidden.in_features
        self.lstm = nn.LSTM(*sizes, batch_first=True, device=weight.device, dtype=weight.dtype)
        with torch.no_grad():
            self.lstm.weight_ih_l0.copy_(weight)
            self.lstm.weight_hh_l0.copy_(layer.hidden.weight)
            self.lstm.bias_ih_l0.copy_(layer.input.bias)
            self.lstm.bias_hh_l0.zero_()

    def forward(self, x: Tensor, spirals: Tensor, metric: Tensor | None = None) -> Tensor:
        sequences = x[spirals]
        if self.metric:
            sequences = torch.cat([sequences, metric.to(x.dtype)], dim=2)
        return self.lstm(sequences)[1][0][0]


class ReferenceSpiralConv(nn.Module):
    """`SpiralConv` on spirals without padding: a convolution of the gathered spirals."""

    def __init__(self, layer: SpiralConv):
        super().__init__()
        self.layer = copy.deepcopy(layer)

    def forward(self, x: Tensor, spirals: Tensor, metric: Tensor | None = None) -> Tensor:
        layer = self.layer
        kernel = layer.taps_in.weight.view(layer.taps, layer.hidden, -1).permute(1, 2, 0)
        hidden = F.conv1d(x[spirals].mT, kernel, padding=layer.taps // 2).mT + layer.position
        if layer.metric is not None:
            hidden = hidden + layer.metric(metric)
        return layer.out((torch.relu(hidden) * layer.sum).sum(1))


class ReferenceGeodesicConv(nn.Module):
    """`GeodesicConv` with every rotation of the template written out."""

    def __init__(self, layer: GeodesicConv):
        super().__init__()
        self.weight = nn.Parameter(layer.weight.detach().clone())

    def forward(self, x: Tensor, resampling: Resampling) -> Tensor:
        outs, rays, rings, channels = self.weight.shape
        samples = sparse_product(resampling, x)
        # rotating the template instead of the patches gives the same set, in another order
        rotations = torch.stack([self.weight.roll(t, 1) for t in range(rays)])
        products = samples.view(-1, rays * rings * channels) @ rotations.view(rays * outs, -1).T
        return products.view(-1, rays, outs).amax(1)


class ReferenceGaussianMixtureConv(nn.Module):
    """`GaussianMixtureConv` with the weights and features of all disks in memory at once."""

    def __init__(self, layer: GaussianMixtureConv):
        super().__init__()
        self.layer = copy.deepcopy(layer)

    def forward(self, x: Tensor, disks: Disks) -> Tensor:
        layer, (vertices, distances, angles) = self.layer, disks
        offsets = distances[:, None] - layer.mean_distance[:, None]
        turned = torch.remainder(angles[:, None] - layer.mean_angle[:, None] + math.pi, 2 * math.pi)
        turned = (turned - math.pi) * (distances > 0)[:, None]
        widths = torch.exp(layer.log_width)[..., None]
        weights = torch.exp(-0.5 * ((offsets / widths[:, 0]) ** 2 + (turned / widths[:, 1]) ** 2))
        weights = weights * (vertices >= 0)[:, None]
        means = (weights / weights.sum(2, keepdim=True)) @ x[vertices.clamp(min=0)]
        return layer.linear(means.flatten(1))


class ReferenceDiffusionBlock(nn.Module):
    """`DiffusionBlock` with gradients as complex numbers."""

    def __init__(self, block: DiffusionBlock):
        super().__init__()
        self.time = nn.Parameter(block.diffusion.time.detach().clone())
        parts = block.features.real.weight, block.features.imaginary.weight
        self.matrix = nn.Parameter(torch.complex(*(part.detach() for part in parts)))
        self.perceptron = copy.deepcopy(block.perceptron)

    def forward(self, x: Tensor, operators: SurfaceOperators) -> Tensor:
        values, functions, masses, gradients = operators
        decay = torch.exp(-torch.outer(values, self.time.clamp(min=LEAST_TIME)))
        diffused = functions @ (decay * (functions.T @ (masses[:, None] * x)))
        along, across = sparse_product(gradients, diffused).view(len(x), 2, -1).unbind(1)
        z = torch.complex(along, across)
        features = torch.tanh((z.conj() * (z @ self.matrix.T)).real)
        return x + self.perceptron(torch.cat([x, diffused, features], dim=1))


def sparse_product(matrix: Resampling, x: Tensor) -> Tensor:
    """The product of a sparse matrix and a dense one, with all its terms in memory at once."""
    vertices, weights, first, *_ = matrix
    terms = x[vertices] * weights[:, None].to(x.dtype)
    rows = torch.arange(len(first) - 1, device=x.device).repeat_interleave(first.diff())
    return x.new_zeros(len(first) - 1, x.shape[1]).index_add(0, rows, terms)


REFERENCES: dict[type[nn.Module], Callable[[Any], nn.Module]] = {
    SpiralLinear: ReferenceSpiralLinear,
    SpiralLSTM: ReferenceSpiralLSTM,
    SpiralConv: ReferenceSpiralConv,
    GeodesicConv: ReferenceGeodesicConv,
    GaussianMixtureConv: ReferenceGaussianMixtureConv,
    DiffusionBlock: ReferenceDiffusionBlock,
}
