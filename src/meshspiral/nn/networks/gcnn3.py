"""GCNN3, the baseline (Masci et al. 2015): geodesic convolutions on polar patches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor, nn

from meshspiral.nn.geodesic import GeodesicConv, Resampling
from meshspiral.nn.networks.three_layers import ThreeLayerNet


class GCNN3(ThreeLayerNet, name="gcnn3"):
    """GCNN3: three geodesic convolutions on polar patches.

    Args:
        in_features: Number of channels of the descriptor.
        num_classes: Number of vertices of the template.
        channels: Number of output channels of each of the three layers.
        rings: Number of rings of a patch.
        rays: Number of rays of a patch, even.
        **options: `dropout`, `feature_scale` and `lifted` of `ThreeLayerNet`.
    """

    title = "GCNN3"
    reads = "patches"

    def __init__(
        self,
        in_features: int,
        num_classes: int,
        channels: Sequence[int] = (32, 64, 128),
        rings: int = 5,
        rays: int = 16,
        **options: Any,
    ):
        self.rings, self.rays = rings, rays
        super().__init__(in_features, num_classes, channels, **options)

    @classmethod
    def options(cls, neighbourhood: Any) -> dict[str, Any]:
        return dict(zip(("rings", "rays"), neighbourhood.grid, strict=True))

    def layer(self, i: int, in_features: int, out_features: int) -> nn.Module:
        return GeodesicConv(in_features, out_features, self.rings, self.rays)

    def embed_batch(self, batch: Mapping[str, Any]) -> Tensor:
        return self.embed(batch["features"], Resampling(**batch["patches"]))

    def embed(self, features: Tensor, resampling: Resampling) -> Tensor:
        """Everything but the last layer.

        Args:
            features: float [V, in_features].
            resampling: The patches' samples as sums of vertices.

        Returns:
            float [V, 256].
        """
        return super().embed(features, resampling)
