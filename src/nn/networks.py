"""The networks of Lim et al. 2018, table 1: three layers on spirals between dense ones.

`net(features, spirals, metric)` gives scores over the template's vertices. Training does not need
all scores at once: it takes `net.embed(...)`, and `net.head`, the last layer, goes into the loss.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from src.nn.layers import SpiralLinear, SpiralLSTM, dense

METRIC_PLACES = ("all", "first")


class SpiralNet(nn.Module):
    """FC16, three spiral layers, FC256, FC(num_classes); ReLU after every layer but the last.

    in_features: channels of the descriptor. num_classes: vertices of the template.
    metric: whether spiral layers take metric information; metric_layers: "all" of them, or the
    "first". feature_scale: the constant that the descriptors are multiplied with; a descriptor of
    unit length and 544 channels has entries of about 0.04, far below what the initial weights
    expect. dropout: after FC16 and FC256.
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
        dense_channels: tuple[int, int] = (16, 256),
    ):
        super().__init__()
        if metric_layers not in METRIC_PLACES:
            raise ValueError(f"metric_layers must be one of {METRIC_PLACES}, got {metric_layers!r}")
        first, last = dense_channels
        self.metric, self.feature_scale = metric, feature_scale
        self.lift = dense(in_features, first)
        self.spiral_layers = nn.ModuleList()
        for i, (fan_in, fan_out) in enumerate(zip((first, *channels), channels, strict=False)):
            takes_metric = metric and (i == 0 or metric_layers == "all")
            self.spiral_layers.append(self.spiral_layer(fan_in, fan_out, takes_metric))
        self.neck = dense(channels[-1], last)
        self.head = dense(last, num_classes)
        self.dropout = nn.Dropout(dropout)

    def spiral_layer(self, in_features: int, out_features: int, metric: bool) -> nn.Module:
        raise NotImplementedError

    def embed(self, features: Tensor, spirals: Tensor, metric: Tensor | None = None) -> Tensor:
        """float [V, 256], everything but the last layer.

        features: float [V, in_features]. spirals: int64 [V, N], -1 where one has ended.
        metric: float [V, N, 2]. ValueError if it is missing, or given to a network without.
        """
        if (metric is not None) != self.metric:
            raise ValueError("this network was made with" + ("" if self.metric else "out")
                             + " metric information")  # fmt: skip
        x = self.dropout(torch.relu(self.lift(features * self.feature_scale)))
        for layer in self.spiral_layers:
            x = torch.relu(layer(x, spirals, metric if layer.metric is not None else None))
        return self.dropout(torch.relu(self.neck(x)))

    def forward(self, features: Tensor, spirals: Tensor, metric: Tensor | None = None) -> Tensor:
        """Scores, float [V, num_classes], before the softmax. Arguments as for `embed`."""
        return self.head(self.embed(features, spirals, metric))


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
