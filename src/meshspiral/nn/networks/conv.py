"""CONV-NET: 1-D convolutions along spirals, which Lim et al. 2018 propose instead of LSTM cells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from pydantic import Field, field_validator
from torch import Tensor, nn

from meshspiral.nn.layers import METRIC_FEATURES, glorot
from meshspiral.nn.networks.spiral_net import OneLengthNet


class SpiralConv(nn.Module):
    """A convolution along the spiral, weighted sums over the positions, and a linear map.

    The convolution's weights are shared by all positions; each position adds its own bias, and
    each hidden channel sums its positions with weights of its own:
    out = W2 sum_n a[n] relu(sum_k W1[k] x[s[n + k - taps // 2]] + b[n] + M metric[n]) + c.

    Args:
        in_features: Number of input channels per vertex.
        out_features: Number of output channels per vertex.
        length: Number of elements N of every spiral, padding included.
        hidden: Number of hidden channels.
        taps: Length of the convolution's kernel, odd.
        metric: Whether the layer also takes metric features.
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        length: int,
        hidden: int,
        taps: int = 3,
        metric: bool = False,
    ):
        super().__init__()
        self.length, self.taps, self.hidden = length, taps, hidden
        self.taps_in = nn.Linear(in_features, taps * hidden, bias=False)
        self.metric = nn.Linear(METRIC_FEATURES, hidden, bias=False) if metric else None
        self.position = nn.Parameter(torch.zeros(length, hidden))
        self.sum = nn.Parameter(torch.empty(length, hidden))
        self.out = nn.Linear(hidden, out_features)
        fan_in = taps * in_features + METRIC_FEATURES * metric
        for layer in filter(None, (self.taps_in, self.metric)):
            glorot(layer.weight, fan_in, hidden)
        nn.init.normal_(self.sum, std=length**-0.5)
        nn.init.xavier_uniform_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, features: Tensor, spirals: Tensor, metric: Tensor | None = None) -> Tensor:
        """Apply the layer.

        Args:
            features: Vertex features, float [V, in_features].
            spirals: Vertex indices, int64 [R, length], padded with -1.
            metric: Metric features, float [R, length, 2]; required if the layer was built with
                `metric`, ignored otherwise.

        Returns:
            float [R, out_features].

        Raises:
            ValueError: The spirals do not have the layer's length.
        """
        if spirals.shape[1] != self.length:
            raise ValueError(f"spirals must have length {self.length}, got {spirals.shape[1]}")
        # Project vertices, not elements: V products instead of R N. Element n then sums one row of
        # each tap, found at taps * vertex + tap; padding and the ends of a spiral read no row.
        rows = self.taps_in(features).view(-1, self.hidden)
        reach = self.taps // 2
        around = nn.functional.pad(spirals, (reach, reach), value=-1).unfold(1, self.taps, 1)
        tap = torch.arange(self.taps, device=spirals.device)
        nothing = len(rows)
        indices = torch.where(around < 0, nothing, around * self.taps + tap)
        rows = torch.cat([rows, rows.new_zeros(1, self.hidden)]).to(self.position.dtype)
        hidden = nn.functional.embedding_bag(indices.view(-1, self.taps), rows, mode="sum")
        hidden = hidden.view(*spirals.shape, self.hidden) + self.position
        if self.metric is not None:
            hidden = hidden + self.metric(metric)
        hidden = torch.relu(hidden).masked_fill((spirals < 0)[..., None], 0.0)
        return self.out((hidden * self.sum).sum(dim=1))


class ConvNet(OneLengthNet, name="conv"):
    """Three convolutions along spirals of fixed length.

    Args:
        in_features: Number of input channels of the descriptor.
        num_classes: Number of vertices of the template.
        seq_len: Number of vertices of every spiral.
        channels: Number of output channels of each of the three layers.
        widening: Number of hidden channels of a layer over that of its output channels.
        taps: Length of the convolution's kernel, odd.
        **options: `metric`, `metric_layers`, `dropout`, `feature_scale` and `lifted` of
            `SpiralNet`.
    """

    title = "CONV-NET"

    class Settings(OneLengthNet.Settings):
        widening: int = Field(ge=1, description="hidden channels of a layer per output channel")
        taps: int = Field(ge=1, description="length of the convolution's kernel, odd")

        @field_validator("taps")
        @classmethod
        def _odd(cls, taps: int) -> int:
            if taps % 2 == 0:
                raise ValueError("must be odd")
            return taps

    def __init__(
        self,
        in_features: int,
        num_classes: int,
        seq_len: int,
        channels: Sequence[int] = (128, 192, 256),
        widening: int = 2,
        taps: int = 3,
        **options: Any,
    ):
        self.seq_len, self.widening, self.taps = seq_len, widening, taps
        super().__init__(in_features, num_classes, channels, **options)

    def spiral_layer(self, in_features: int, out_features: int, metric: bool) -> nn.Module:
        hidden = self.widening * out_features
        return SpiralConv(in_features, out_features, self.seq_len, hidden, self.taps, metric)
