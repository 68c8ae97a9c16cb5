"""LSTM-NET (Lim et al. 2018): an LSTM along each spiral."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import Field
from torch import nn

from meshspiral.nn.layers import SpiralLSTM
from meshspiral.nn.networks.spiral_net import SpiralNet


class LSTMNet(SpiralNet, name="lstm"):
    """LSTM-NET: an LSTM along each spiral; lengths may be any, and differ.

    Args:
        in_features: Number of channels of the descriptor.
        num_classes: Number of vertices of the template.
        channels: Number of output channels of each of the three layers.
        recompute: Whether to compute the LSTM's steps again in the backward pass, for less memory.
        **options: `metric`, `metric_layers`, `dropout`, `feature_scale` and `lifted` of
            `SpiralNet`.
    """

    title = "LSTM-NET"

    class Settings(SpiralNet.Settings):
        recompute: bool = Field(
            description="compute the steps again in the backward pass: less memory, more time"
        )

    def __init__(
        self,
        in_features: int,
        num_classes: int,
        channels: Sequence[int] = (150, 200, 250),
        recompute: bool = False,
        **options: Any,
    ):
        self.recompute = recompute
        super().__init__(in_features, num_classes, channels, **options)

    def spiral_layer(self, in_features: int, out_features: int, metric: bool) -> nn.Module:
        return SpiralLSTM(in_features, out_features, metric, self.recompute)
