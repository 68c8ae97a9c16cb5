"""FCS-NET (Lim et al. 2018): a fully connected layer over each spiral."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import nn

from meshspiral.nn.layers import SpiralLinear
from meshspiral.nn.networks.spiral_net import OneLengthNet


class FCSNet(OneLengthNet, name="fcs"):
    """FCS-NET: a fully connected layer over each spiral of fixed length.

    Args:
        in_features: Number of channels of the descriptor.
        num_classes: Number of vertices of the template.
        seq_len: Number of vertices of every spiral.
        channels: Number of output channels of each of the three layers.
        **options: `metric`, `metric_layers`, `dropout`, `feature_scale` and `lifted` of
            `SpiralNet`.
    """

    title = "FCS-NET"

    def __init__(
        self,
        in_features: int,
        num_classes: int,
        seq_len: int,
        channels: Sequence[int] = (100, 150, 200),
        **options: Any,
    ):
        self.seq_len = seq_len
        super().__init__(in_features, num_classes, channels, **options)

    def spiral_layer(self, in_features: int, out_features: int, metric: bool) -> nn.Module:
        return SpiralLinear(in_features, out_features, self.seq_len, metric)
