"""The base class of networks, and their registry (Lim et al. 2018, table 1).

`net(features, ...)` returns scores over the template's vertices. Training never forms all scores at
once: it calls `net.embed_batch(batch)`, and the loss applies the last layer, `net.head`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, ClassVar

import torch
from pydantic import BaseModel, Field, field_validator
from torch import Tensor, nn

from meshspiral.nn.layers import dense

LIFTED, LAST = 16, 256  # channels after the first dense layer and before the last


class Network(nn.Module):
    """FC16, three layers on neighbourhoods, FC256, FC(num_classes); ReLU after all but the last.

    A subclass registers under a name, `class FCSNet(SpiralNet, name="fcs")`, and implements
    `layer` and `embed_batch`. It overrides `options` to use settings of its neighbourhood, and
    `check` to refuse some.

    Class attributes:
        registered: All networks, by name.
        title: The network's name in plots and tables.
        reads: Name of the batch entry that the network reads; a neighbourhood fits if its `gives`
            equals it.

    Args:
        in_features: Number of channels of the descriptor.
        num_classes: Number of vertices of the template.
        channels: Number of output channels of each of the three layers.
        dropout: Probability of dropout after FC16 and FC256.
        feature_scale: Constant factor of the descriptors. A descriptor of unit length with 544
            channels has entries of about 0.04, far below what the initial weights expect.
    """

    registered: ClassVar[dict[str, type[Network]]] = {}
    name: ClassVar[str]
    title: ClassVar[str]
    reads: ClassVar[str]

    class Settings(BaseModel, extra="forbid", strict=True, frozen=True):
        """The config group `model`."""

        name: str
        channels: list[int] = Field(description="output channels of the three layers")
        dropout: float = Field(
            ge=0, lt=1, description="dropout after the first dense layer and before the last"
        )
        feature_scale: float = Field(
            gt=0,
            description="factor of descriptors; sqrt(544) makes their entries about 1 (paper: 1)",
        )

        @field_validator("channels")
        @classmethod
        def _three(cls, channels: list[int]) -> list[int]:
            if len(channels) != 3 or min(channels) < 1:
                raise ValueError("must be three numbers of at least 1")
            return channels

    def __init_subclass__(cls, name: str | None = None, **options: Any) -> None:
        super().__init_subclass__(**options)
        if name is not None:
            cls.name = name
            Network.registered[name] = cls

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

    @classmethod
    def check(cls, neighbourhood: Any) -> None:
        """Raise ValueError if the network cannot read a `Neighbourhood` that gives `reads`."""

    @classmethod
    def build(
        cls, settings: Any, neighbourhood: Any, in_features: int, num_classes: int
    ) -> Network:
        """The network of a config.

        Args:
            settings: Of the class's `Settings`.
            neighbourhood: The `Neighbourhood` that it reads.
            in_features: Number of channels of the descriptor.
            num_classes: Number of vertices of the template.
        """
        options = settings.model_dump(exclude={"name"})
        return cls(in_features, num_classes, **options, **cls.options(neighbourhood))

    @classmethod
    def options(cls, neighbourhood: Any) -> dict[str, Any]:
        """Arguments of the constructor that the neighbourhood decides."""
        return {}

    def layer(self, i: int, in_features: int, out_features: int) -> nn.Module:
        """The i-th of the three layers."""
        raise NotImplementedError

    def embed_batch(self, batch: Mapping[str, Any]) -> Tensor:
        """`embed` of the batch entries that the network reads: `features` and its neighbourhood."""
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
