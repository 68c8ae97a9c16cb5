"""The networks as one would first write them, to measure and to test the fast ones against."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from meshspiral.neighbourhoods.base import Batch
from meshspiral.nn.geodesic import GeodesicConv, Resampling
from meshspiral.nn.layers import SpiralLinear, SpiralLSTM
from meshspiral.nn.networks import Network


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


class ReferenceGeodesicConv(nn.Module):
    """`GeodesicConv` with every rotation of the template written out."""

    def __init__(self, layer: GeodesicConv):
        super().__init__()
        self.weight = nn.Parameter(layer.weight.detach().clone())

    def forward(self, x: Tensor, resampling: Resampling) -> Tensor:
        outs, rays, rings, channels = self.weight.shape
        vertices, weights, first, *_ = resampling
        terms = x[vertices] * weights[:, None].to(x.dtype)
        rows = torch.arange(len(first) - 1, device=x.device).repeat_interleave(first.diff())
        samples = x.new_zeros(len(first) - 1, channels).index_add(0, rows, terms)
        # rotating the template instead of the patches gives the same set, in another order
        rotations = torch.stack([self.weight.roll(t, 1) for t in range(rays)])
        products = samples.view(-1, rays * rings * channels) @ rotations.view(rays * outs, -1).T
        return products.view(-1, rays, outs).amax(1)


REFERENCES: dict[type[nn.Module], Callable[[Any], nn.Module]] = {
    SpiralLinear: ReferenceSpiralLinear,
    SpiralLSTM: ReferenceSpiralLSTM,
    GeodesicConv: ReferenceGeodesicConv,
}
