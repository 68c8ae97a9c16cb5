"""ACNN (Boscaini, Masci, Rodola, Bronstein 2016): convolutions on anisotropic heat kernels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import torch
from pydantic import Field, field_validator
from torch import Tensor, nn

from meshspiral.nn.geodesic import GeodesicConv, Resampling
from meshspiral.nn.layers import dense as dense_layer
from meshspiral.nn.networks.base import Network


class ACNN(Network, name="acnn"):
    """ACNN as in its authors' published code.

    A dense layer, convolutions on the kernels, a linear layer without bias, further dense layers,
    and the last layer; ReLU and batch normalisation after all but the linear one and the last, the
    latter not after the first. A convolution keeps its largest response among rotations, as
    GCNN3's, though the kernels are aligned.

    Args:
        in_features: Number of channels of the descriptor.
        num_classes: Number of vertices of the template.
        lifted: Number of channels after the first layer.
        channels: Number of output channels of each convolution.
        dense: Number of channels of the linear layer and of those behind it; may be empty.
        rings: Number of diffusion times.
        rays: Number of angles, even.
        feature_scale: Constant factor of the descriptors.
    """

    title = "ACNN"
    reads = "patches"

    class Settings(Network.Settings):
        lifted: int = Field(ge=1, description="channels after the first layer")
        channels: list[int] = Field(min_length=1, description="output channels of each convolution")
        dense: list[int] = Field(
            description="channels of the linear layer behind, and of further layers; may be empty"
        )

        @field_validator("channels", "dense")
        @classmethod
        def _positive(cls, channels: list[int]) -> list[int]:
            if channels and min(channels) < 1:
                raise ValueError("must be numbers of at least 1")
            return channels

    def __init__(
        self,
        in_features: int,
        num_classes: int,
        lifted: int = 64,
        channels: Sequence[int] = (64, 128, 256),
        dense: Sequence[int] = (1024, 512),
        rings: int = 5,
        rays: int = 16,
        feature_scale: float = 1.0,
    ):
        super().__init__()
        self.feature_scale = feature_scale
        self.lift = dense_layer(in_features, lifted)
        self.layers = nn.ModuleList(
            GeodesicConv(*sizes, rings, rays) for sizes in pairwise((lifted, *channels))
        )
        self.norms = nn.ModuleList(nn.BatchNorm1d(size) for size in channels)
        neck: list[nn.Module] = []
        for i, sizes in enumerate(pairwise((channels[-1], *dense))):
            if i == 0:
                neck += [nn.Linear(*sizes, bias=False)]
            else:
                neck += [dense_layer(*sizes), nn.ReLU(), nn.BatchNorm1d(sizes[1])]
        self.neck = nn.Sequential(*neck)
        self.head = dense_layer((channels[-1], *dense)[-1], num_classes)

    @classmethod
    def options(cls, neighbourhood: Any) -> dict[str, Any]:
        return dict(zip(("rings", "rays"), neighbourhood.grid, strict=True))

    def embed_batch(self, batch: Mapping[str, Any]) -> Tensor:
        return self.embed(batch["features"], Resampling(**batch["patches"]))

    def embed(self, features: Tensor, kernels: Resampling) -> Tensor:
        """Everything but the last layer.

        Args:
            features: float [V, in_features].
            kernels: The kernels as sums over vertices.

        Returns:
            float [V, head.in_features].
        """
        x = torch.relu(self.lift(features * self.feature_scale))
        for layer, norm in zip(self.layers, self.norms, strict=True):
            x = norm(torch.relu(layer(x, kernels)))
        return self.neck(x)

    def forward(self, features: Tensor, kernels: Resampling) -> Tensor:
        """Scores before the softmax, float [V, num_classes]. Arguments as for `embed`."""
        return self.head(self.embed(features, kernels))
