"""The base class of networks whose layers read spirals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

from pydantic import Field
from torch import Tensor, nn

from meshspiral.nn.geodesic import Resampling, resample
from meshspiral.nn.layers import metric_features
from meshspiral.nn.networks.three_layers import ThreeLayerNet

MetricLayers = Literal["all", "first"]


class SpiralNet(ThreeLayerNet):
    """A network with three layers on sequences of vertices. A subclass implements `spiral_layer`.

    Args:
        in_features: Number of channels of the descriptor.
        num_classes: Number of vertices of the template.
        channels: Number of output channels of each of the three layers.
        metric: Whether layers read metric information, see `metric_features`.
        metric_layers: "all" layers read it, or the "first" alone.
        **options: `dropout`, `feature_scale` and `lifted` of `ThreeLayerNet`.

    Raises:
        ValueError: `metric_layers` is neither "all" nor "first".
    """

    reads = "spirals"

    class Settings(ThreeLayerNet.Settings):
        metric: bool = Field(description="read metric information: distance and angle")
        metric_layers: MetricLayers = Field(
            description="spiral layers that read metric information: all, or the first alone"
        )

    def __init__(
        self,
        in_features: int,
        num_classes: int,
        channels: Sequence[int],
        metric: bool = False,
        metric_layers: str = "all",
        **options: Any,
    ):
        if metric_layers not in (choices := get_args(MetricLayers)):
            raise ValueError(f"metric_layers must be one of {choices}, got {metric_layers!r}")
        self.metric, self.metric_layers = metric, metric_layers
        super().__init__(in_features, num_classes, channels, **options)

    def layer(self, i: int, in_features: int, out_features: int) -> nn.Module:
        takes_metric = self.metric and (i == 0 or self.metric_layers == "all")
        return self.spiral_layer(in_features, out_features, takes_metric)

    def spiral_layer(self, in_features: int, out_features: int, metric: bool) -> nn.Module:
        """One of the three layers.

        Args:
            in_features: Number of input channels.
            out_features: Number of output channels.
            metric: Whether the layer reads metric information.

        Returns:
            A module that takes features [V, in_features], spirals [V, N] and metric information
            [V, N, 2] or None, and returns [V, out_features].
        """
        raise NotImplementedError

    def embed_batch(self, batch: Mapping[str, Any]) -> Tensor:
        spirals, places = batch["spirals"], batch.get("places")
        if isinstance(places, dict):
            places = Resampling(**places)
        elif places is not None:
            places = tuple(Resampling(**each) for each in places)
        metric = None
        if self.metric:
            vertices, unit = batch["vertices"], batch["unit"]
            metric = []
            for i in range(len(spirals) if isinstance(spirals, tuple) else 1):
                sequences, sampled = _of_layer(i, spirals, places)
                points = vertices if sampled is None else resample(vertices, sampled)
                values = metric_features(points, sequences.flatten(0, -2), unit)
                metric.append(values.unflatten(0, sequences.shape[:-1]))
            metric = tuple(metric) if isinstance(spirals, tuple) else metric[0]
        return self.embed(batch["features"], spirals, metric, places)

    def embed(
        self,
        features: Tensor,
        spirals: Tensor | tuple[Tensor, ...],
        metric: Tensor | tuple[Tensor, ...] | None = None,
        places: Resampling | tuple[Resampling, ...] | None = None,
    ) -> Tensor:
        """Everything but the last layer. A tuple has an entry for each of the three layers.

        Args:
            features: float [V, in_features].
            spirals: int64 [V, N], -1 where a spiral has ended; vertices, or rows of `places`.
                int64 [V, S, N] for the maximum over S spirals of each vertex.
            metric: float [V, N, 2] or [V, S, N, 2], see `metric_features`.
            places: Points whose features are blended from those of vertices; None for vertices.

        Returns:
            float [V, 256].

        Raises:
            ValueError: `metric` is missing, or given to a network without metric information.
        """
        if (metric is not None) != self.metric:
            negation = "" if self.metric else "out"
            raise ValueError(f"this network was made with{negation} metric information")
        return super().embed(features, spirals, metric, places)

    def convolve(self, i: int, x: Tensor, *neighbourhood) -> Tensor:
        spirals, metric, places = _of_layer(i, *neighbourhood)
        if places is not None:
            x = resample(x, places)
        if spirals.ndim == 2:
            return self.layers[i](x, spirals, metric)
        starts = spirals.shape[:2]
        metric = None if metric is None else metric.flatten(0, 1)
        return self.layers[i](x, spirals.flatten(0, 1), metric).unflatten(0, starts).amax(1)


class OneLengthNet(SpiralNet):
    """A network on spirals of one length. Its constructor takes that length as `seq_len`."""

    @classmethod
    def check(cls, neighbourhood: Any) -> None:
        if neighbourhood.length is None:
            raise ValueError(f"{cls.name} needs sequences of one length, got {neighbourhood.title}")

    @classmethod
    def options(cls, neighbourhood: Any) -> dict[str, Any]:
        return {"seq_len": neighbourhood.length}


def _of_layer(i: int, *values: Any) -> list[Any]:
    """What the i-th layer reads of values that may be tuples with an entry for each layer."""
    return [v[i] if type(v) is tuple else v for v in values]  # a Resampling is a tuple too
