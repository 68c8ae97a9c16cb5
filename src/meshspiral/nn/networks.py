"""The networks of Lim et al. 2018, table 1: three layers on neighbourhoods between dense ones.

`net(features, ...)` gives scores over the template's vertices. Training does not need all scores at
once: it takes `net.embed(...)`, and `net.head`, the last layer, goes into the loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from meshspiral.nn.geodesic import GeodesicConv, Resampling
from meshspiral.nn.layers import SpiralLinear, SpiralLSTM, dense

METRIC_PLACES = ("all", "first")
LIFTED, LAST = 16, 256  # channels after the first dense layer and before the last


class Network(nn.Module):
    """FC16, three layers on neighbourhoods, FC256, FC(num_classes); ReLU after all but the last.

    in_features: channels of the descriptor. num_classes: vertices of the template.
    channels: of the three layers. dropout: after FC16 and FC256. feature_scale: the constant that
    the descriptors are multiplied with; a descriptor of unit length and 544 channels has entries of
    about 0.04, far below what the initial weights expect.
    """

    def __init__(
        self,
        in_features: int,
        num_classes: int,
        channels: Sequence[int],
        dropout: float,
        feature_scale: float,
    ):
        super().__init__()
        self.feature_scale = feature_scale
        self.lift = dense(in_features, LIFTED)
        self.layers = nn.ModuleList(
            self.layer(i, *sizes) for i, sizes in enumerate(pairwise((LIFTED, *channels)))
        )
        self.neck = dense(channels[-1], LAST)
        self.head = dense(LAST, num_classes)
        self.dropout = nn.Dropout(dropout)

    def layer(self, i: int, in_features: int, out_features: int) -> nn.Module:
        """The i-th of the three layers."""
        raise NotImplementedError

    def embed(self, features: Tensor, *neighbourhood) -> Tensor:
        """float [V, 256], everything but the last layer. features: float [V, in_features]."""
        x = self.dropout(torch.relu(self.lift(features * self.feature_scale)))
        for layer in self.layers:
            x = torch.relu(layer(x, *neighbourhood))
        return self.dropout(torch.relu(self.neck(x)))

    def forward(self, features: Tensor, *neighbourhood) -> Tensor:
        """Scores, float [V, num_classes], before the softmax. Arguments as for `embed`."""
        return self.head(self.embed(features, *neighbourhood))


class SpiralNet(Network):
    """Three layers on spirals.

    metric: whether they take metric information; metric_layers: "all" of them, or the "first".
    """

    def __init__(
        self,
        in_features: int,
        num_classes: int,
        channels: Sequence[int],
        metric: bool,
        metric_layers: str,
        dropout: float,
        feature_scale: float,
    ):
        if metric_layers not in METRIC_PLACES:
            raise ValueError(f"metric_layers must be one of {METRIC_PLACES}, got {metric_layers!r}")
        self.metric, self.metric_layers = metric, metric_layers
        super().__init__(in_features, num_classes, channels, dropout, feature_scale)

    def layer(self, i: int, in_features: int, out_features: int) -> nn.Module:
        takes_metric = self.metric and (i == 0 or self.metric_layers == "all")
        return self.spiral_layer(in_features, out_features, takes_metric)

    def spiral_layer(self, in_features: int, out_features: int, metric: bool) -> nn.Module:
        raise NotImplementedError

    def embed(self, features: Tensor, spirals: Tensor, metric: Tensor | None = None) -> Tensor:
        """float [V, 256], everything but the last layer.

        features: float [V, in_features]. spirals: int64 [V, N], -1 where one has ended.
        metric: float [V, N, 2]. ValueError if it is missing, or given to a network without.
        """
        if (metric is not None) != self.metric:
            raise ValueError(
                "this network was made with"
                + ("" if self.metric else "out")
                + " metric information"
            )
        return super().embed(features, spirals, metric)


class FCSNet(SpiralNet):
    """FCS-NET: a fully connected layer over each spiral of fixed length seq_len."""

    def __init__(
        self,
        in_features: int,
        num_classes: int,
        seq_len: int,
        channels: Sequence[int] = (100, 150, 200),
        metric: bool = False,
        metric_layers: str = "all",
        dropout: float = 0.3,
        feature_scale: float = 1.0,
    ):
        self.seq_len = seq_len
        super().__init__(
            in_features, num_classes, channels, metric, metric_layers, dropout, feature_scale
        )

    def spiral_layer(self, in_features: int, out_features: int, metric: bool) -> nn.Module:
        return SpiralLinear(in_features, out_features, self.seq_len, metric)


class LSTMNet(SpiralNet):
    """LSTM-NET: an LSTM along each spiral, of any length and of lengths that differ."""

    def __init__(
        self,
        in_features: int,
        num_classes: int,
        channels: Sequence[int] = (150, 200, 250),
        metric: bool = False,
        metric_layers: str = "all",
        dropout: float = 0.3,
        feature_scale: float = 1.0,
    ):
        super().__init__(
            in_features, num_classes, channels, metric, metric_layers, dropout, feature_scale
        )

    def spiral_layer(self, in_features: int, out_features: int, metric: bool) -> nn.Module:
        return SpiralLSTM(in_features, out_features, metric)


class GCNN3(Network):
    """GCNN3, the baseline of the paper: geodesic convolutions on polar patches of rings x rays.

    `embed` and the call take features float [V, in_features] and a `Resampling`.
    """

    def __init__(
        self,
        in_features: int,
        num_classes: int,
        channels: Sequence[int] = (32, 64, 128),
        rings: int = 5,
        rays: int = 16,
        dropout: float = 0.3,
        feature_scale: float = 1.0,
    ):
        self.rings, self.rays = rings, rays
        super().__init__(in_features, num_classes, channels, dropout, feature_scale)

    def layer(self, i: int, in_features: int, out_features: int) -> nn.Module:
        return GeodesicConv(in_features, out_features, self.rings, self.rays)

    def embed(self, features: Tensor, resampling: Resampling) -> Tensor:
        """float [V, 256], everything but the last layer."""
        return super().embed(features, resampling)
