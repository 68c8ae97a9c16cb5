"""The frame of the paper's networks (Lim et al. 2018, table 1)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from pydantic import Field, field_validator
from torch import Tensor, nn

from meshspiral.nn.dropout import Dropout
from meshspiral.nn.layers import dense
from meshspiral.nn.networks.base import Network

LIFTED, LAST = 16, 256  # channels after the first dense layer and before the last


class ThreeLayerNet(Network):
    """FC16, three layers on neighbourhoods, FC256, FC(num_classes); ReLU after all but the last.

    A subclass implements `layer` and `embed_batch`.

    Args:
        in_features: Number of channels of the descriptor.
        num_classes: Number of vertices of the template.
        channels: Number of output channels of each of the three layers.
        dropout: Probability of dropout after FC16 and FC256.
        feature_scale: Constant factor of the descriptors. A descriptor of unit length with 544
            channels has entries of about 0.04, far below what the initial weights expect.
        lifted: Number of channels after the first dense layer, FC16 in the paper.
    """

    class Settings(Network.Settings):
        channels: list[int] = Field(description="output channels of the three layers")
        dropout: float = Field(
            ge=0, lt=1, description="dropout after the first dense layer and before the last"
        )
        lifted: int = Field(
            LIFTED, ge=1, description="channels after the first dense layer (paper: 16)"
        )

        @field_validator("channels")
        @classmethod
        def _three(cls, channels: list[int]) -> list[int]:
            if len(channels) != 3 or min(channels) < 1:
                raise ValueError("must be three numbers of at least 1")
            return channels

    def __init__(
        self,
        in_features: int,
        num_classes: int,
        channels: Sequence[int],
        dropout: float = 0.3,
        feature_scale: float = 1.0,
        lifted: int = LIFTED,
    ):
        super().__init__()
        self.feature_scale = feature_scale
        self.lift = dense(in_features, lifted)
        self.layers = nn.ModuleList(
            self.layer(i, *sizes) for i, sizes in enumerate(pairwise((lifted, *channels)))
        )
        self.neck = dense(channels[-1], LAST)
        self.head = dense(LAST, num_classes)
        self.dropout = Dropout(dropout)

    def layer(self, i: int, in_features: int, out_features: int) -> nn.Module:
        """The i-th of the three layers."""
        raise NotImplementedError

    def embed(self, features: Tensor, *neighbourhood) -> Tensor:
        """Everything but the last layer.

        Args:
            features: float [V, in_features].
            *neighbourhood: What the three layers take beside their input.

        Returns:
            float [V, 256].
        """
        x = self.dropout(torch.relu(self.lift(features * self.feature_scale)))
        for i in range(len(self.layers)):
            x = torch.relu(self.convolve(i, x, *neighbourhood))
        return self.dropout(torch.relu(self.neck(x)))

    def convolve(self, i: int, x: Tensor, *neighbourhood) -> Tensor:
        """The output of the i-th of the three layers, before the ReLU."""
        return self.layers[i](x, *neighbourhood)

    def forward(self, features: Tensor, *neighbourhood) -> Tensor:
        """Scores before the softmax, float [V, num_classes]. Arguments as for `embed`."""
        return self.head(self.embed(features, *neighbourhood))
