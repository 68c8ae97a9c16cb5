"""DiffusionNet (Sharp, Attaiki, Crane, Ovsjanikov 2022)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import Field
from torch import Tensor, nn

from meshspiral.nn.diffusion import DiffusionBlock, SurfaceOperators
from meshspiral.nn.geodesic import Resampling
from meshspiral.nn.networks.base import Network


class DiffusionNet(Network, name="diffusion"):
    """DiffusionNet: learnt diffusion, gradient features and perceptrons at the vertices.

    A linear layer, blocks, and a linear layer. Initial weights are PyTorch's.

    Args:
        in_features: Number of channels of the descriptor.
        num_classes: Number of vertices of the template.
        width: Number of channels of the blocks.
        blocks: Number of blocks.
        dropout: Probability of dropout within the perceptrons.
        feature_scale: Constant factor of the descriptors.
    """

    title = "DiffusionNet"
    reads = "operators"

    class Settings(Network.Settings):
        width: int = Field(ge=1, description="channels of the blocks")
        blocks: int = Field(ge=1, description="number of blocks")
        dropout: float = Field(ge=0, lt=1, description="dropout within the perceptrons")

    def __init__(
        self,
        in_features: int,
        num_classes: int,
        width: int = 128,
        blocks: int = 4,
        dropout: float = 0.5,
        feature_scale: float = 1.0,
    ):
        super().__init__()
        self.feature_scale = feature_scale
        self.lift = nn.Linear(in_features, width)
        self.blocks = nn.ModuleList(DiffusionBlock(width, dropout) for _ in range(blocks))
        self.head = nn.Linear(width, num_classes)

    def embed_batch(self, batch: Mapping[str, Any]) -> Tensor:
        spectral = dict(batch["operators"])
        gradients = Resampling(**spectral.pop("gradients"))
        return self.embed(batch["features"], SurfaceOperators(**spectral, gradients=gradients))

    def embed(self, features: Tensor, operators: SurfaceOperators) -> Tensor:
        """Everything but the last layer.

        Args:
            features: float [V, in_features].
            operators: Of the mesh.

        Returns:
            float [V, width].
        """
        x = self.lift(features * self.feature_scale).to(features.dtype)
        operators = operators.to(x.dtype)
        for block in self.blocks:
            x = block(x, operators)
        return x

    def forward(self, features: Tensor, operators: SurfaceOperators) -> Tensor:
        """Scores before the softmax, float [V, num_classes]. Arguments as for `embed`."""
        return self.head(self.embed(features, operators))
