"""The networks as one would first write them, to measure and to test the fast ones against.

Neighbourhoods are gathered as they stand, the LSTM is `torch.nn.LSTM`, every rotation is written
out, and all scores exist at once.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from meshspiral.nn.geodesic import GeodesicConv, Resampling
from meshspiral.nn.layers import SpiralLinear, SpiralLSTM
from meshspiral.nn.networks import Network


class PlainNetwork(nn.Module):
    """A copy of a network without metric information: the same weights, the same loss."""

    def __init__(self, net: Network):
        super().__init__()
        self.lift, self.neck, self.head = (_linear(x) for x in (net.lift, net.neck, net.head))
        self.layers = nn.ModuleList(PLAIN[type(layer)](layer) for layer in net.layers)
        self.dropout = nn.Dropout(net.dropout.p)
        self.feature_scale = net.feature_scale

    def loss(self, features: Tensor, neighbourhood: Tensor | Resampling, labels: Tensor) -> Tensor:
        x = self.dropout(torch.relu(self.lift(features * self.feature_scale)))
        for layer in self.layers:
            x = torch.relu(layer(x, neighbourhood))
        x = self.dropout(torch.relu(self.neck(x)))
        return F.cross_entropy(self.head(x), labels)


class PlainSpiralLinear(nn.Module):
    def __init__(self, layer: SpiralLinear):
        super().__init__()
        self.linear = _linear(layer.linear)

    def forward(self, x: Tensor, spirals: Tensor) -> Tensor:
        return self.linear(x[spirals].flatten(1))


class PlainSpiralLSTM(nn.Module):
    def __init__(self, layer: SpiralLSTM):
        super().__init__()
        inputs, width = layer.input.in_features, layer.hidden.in_features
        self.lstm = nn.LSTM(inputs, width, batch_first=True, dtype=layer.input.weight.dtype)
        with torch.no_grad():
            self.lstm.weight_ih_l0.copy_(layer.input.weight)
            self.lstm.weight_hh_l0.copy_(layer.hidden.weight)
            self.lstm.bias_ih_l0.copy_(layer.input.bias)
            self.lstm.bias_hh_l0.zero_()

    def forward(self, x: Tensor, spirals: Tensor) -> Tensor:
        return self.lstm(x[spirals])[1][0][0]


class PlainGeodesicConv(nn.Module):
    """Where every sample is there, and blended from three vertices."""

    def __init__(self, layer: GeodesicConv):
        super().__init__()
        self.weight = nn.Parameter(layer.weight.detach().clone())

    def forward(self, x: Tensor, resampling: Resampling) -> Tensor:
        outs, rays, rings, channels = self.weight.shape
        corners = x[resampling.vertices.view(-1, 3)]
        samples = (corners * resampling.weights.view(-1, 3, 1).to(x.dtype)).sum(1)
        # to turn the template is to turn the patches the other way, and the maximum does not mind
        rotations = torch.stack([self.weight.roll(t, 1) for t in range(rays)])
        products = samples.view(-1, rays * rings * channels) @ rotations.view(rays * outs, -1).T
        return products.view(-1, rays, outs).amax(1)


PLAIN = {
    SpiralLinear: PlainSpiralLinear,
    SpiralLSTM: PlainSpiralLSTM,
    GeodesicConv: PlainGeodesicConv,
}


def _linear(layer: nn.Linear) -> nn.Linear:
    copy = nn.Linear(layer.in_features, layer.out_features, dtype=layer.weight.dtype)
    copy.load_state_dict(layer.state_dict())
    return copy
