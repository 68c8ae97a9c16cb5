"""MoNet (Monti et al. 2017): Gaussian mixtures on geodesic polar coordinates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import Field
from torch import Tensor, nn

from meshspiral.nn.gaussian import Disks, GaussianMixtureConv
from meshspiral.nn.networks.three_layers import ThreeLayerNet


class MoNet(ThreeLayerNet, name="monet"):
    """MoNet: three Gaussian mixture convolutions, in the frame of GCNN3.

    Args:
        in_features: Number of channels of the descriptor.
        num_classes: Number of vertices of the template.
        channels: Number of output channels of each of the three layers.
        rings: Number of distances at which Gaussians begin.
        rays: Number of directions in which they begin.
        **options: `dropout`, `feature_scale` and `lifted` of `ThreeLayerNet`.
    """

    title = "MoNet"
    reads = "disks"

    class Settings(ThreeLayerNet.Settings):
        rings: int = Field(ge=1, description="distances at which Gaussians begin")
        rays: int = Field(ge=1, description="directions in which Gaussians begin")

    def __init__(
        self,
        in_features: int,
        num_classes: int,
        channels: Sequence[int] = (32, 64, 128),
        rings: int = 3,
        rays: int = 8,
        **options: Any,
    ):
        self.rings, self.rays = rings, rays
        super().__init__(in_features, num_classes, channels, **options)

    def layer(self, i: int, in_features: int, out_features: int) -> nn.Module:
        return GaussianMixtureConv(in_features, out_features, self.rings, self.rays)

    def embed_batch(self, batch: Mapping[str, Any]) -> Tensor:
        return self.embed(batch["features"], Disks(**batch["disks"]))
