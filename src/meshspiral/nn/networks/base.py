"""The base class of networks, and their registry.

All networks share `net.embed_batch(batch)`, the
features before the last layer, and `net.head`, the last layer, whose outputs are scores over the
template's vertices. Training never forms all scores at once: the loss applies `net.head` to some
vertices at a time.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from pydantic import BaseModel, Field
from torch import Tensor, nn


class Network(nn.Module):
    """A network that gives every vertex scores over the template's vertices.

    A subclass registers under a name, `class DiffusionNet(Network, name="diffusion")`, has a last
    layer `head`, an `nn.Linear`, and implements `embed_batch`. It overrides `options` to use
    settings of its neighbourhood, and `check` to refuse some. Most derive from `ThreeLayerNet`.

    Class attributes:
        registered: All networks, by name.
        title: The network's name in plots and tables.
        reads: Name of the batch entry that the network reads; a neighbourhood fits if its `gives`
            equals it.
    """

    registered: ClassVar[dict[str, type[Network]]] = {}
    name: ClassVar[str]
    title: ClassVar[str]
    reads: ClassVar[str]
    head: nn.Linear

    class Settings(BaseModel, extra="forbid", strict=True, frozen=True):
        """The config group `model`. Fields but `name` are arguments of the constructor."""

        name: str
        feature_scale: float = Field(
            gt=0,
            description="factor of descriptors; sqrt(544) makes their entries about 1 (paper: 1)",
        )

    def __init_subclass__(cls, name: str | None = None, **options: Any) -> None:
        super().__init_subclass__(**options)
        if name is not None:
            cls.name = name
            Network.registered[name] = cls

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
        options = settings.model_dump(exclude={"name"}, exclude_unset=True)
        return cls(in_features, num_classes, **options, **cls.options(neighbourhood))

    @classmethod
    def options(cls, neighbourhood: Any) -> dict[str, Any]:
        """Arguments of the constructor that the neighbourhood decides."""
        return {}

    def embed_batch(self, batch: Mapping[str, Any]) -> Tensor:
        """The features before the last layer, float [V, head.in_features].

        Args:
            batch: `features`, float [V, in_features], and the entries of the neighbourhood.
        """
        raise NotImplementedError
