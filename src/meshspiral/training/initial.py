"""Fine-tuning: training starts from the weights of another run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from meshspiral.data.descriptors import Features
from meshspiral.experiment.run_folder import BEST, CONFIG, RunError
from meshspiral.experiment.schema import ConfigError, TrainConfig, flat, read_stored_config
from meshspiral.geometry.mesh import Mesh
from meshspiral.training.checkpoints import BUNDLED_RUN, config_of, read_checkpoint, template_of
from meshspiral.training.module import Correspondence, build_network

BUNDLED = "bundled"
HEAD = "net.head."  # the last layer: one output for each vertex of the template
SAME = 1e-4  # largest difference of equal vertices, over the size of the template


class InitialWeights:
    """The weights of another run, checked against the network of a config.

    Args:
        config: Its `init` names a run folder, whose best checkpoint is read, a checkpoint, or
            "bundled", the network of `Matcher`.
        in_features: Number of channels of the descriptor.

    Raises:
        RunError: There is no such run, its checkpoint is damaged or needs a plugin, or its network
            does not fit. The message names the setting.
    """

    def __init__(self, config: TrainConfig, in_features: int):
        self.source = f"init={config.init}"
        self._saved = read_checkpoint(checkpoint_of(config.init))
        self._theirs = config_of(self._saved, self.source)
        self._config = config
        theirs, ours = (_settings_of_weights(c) for c in (self._theirs, config))
        self._different = {
            key: (theirs.get(key), ours.get(key))
            for key in {**theirs, **ours}
            if theirs.get(key) != ours.get(key)
        }
        for key in ("model.name", "neighbourhood.name"):
            if key in self._different:
                raise self._misfit([key])
        channels = self._saved["hyper_parameters"]["in_features"]
        if channels != in_features:
            descriptors = [key for key in self._different if key.startswith("data.")]
            decisive = [key for key in descriptors if self._channels_with_theirs(key) == channels]
            raise self._misfit(decisive or descriptors)
        if misfits := self._misfits(config, in_features):
            # the settings that alone, as there, would make more layers fit
            fewer = (
                key
                for key in self._different
                if self._misfits(self._with_theirs(key), in_features) < misfits
            )
            raise self._misfit(list(fewer) or list(self._different))

    def load_into(self, module: Correspondence, template: Mesh) -> Iterator[str]:
        """Copy the weights into a module, and describe what was copied.

        The last layer is copied only if the template is the same, since its outputs are the
        template's vertices.

        Args:
            module: Built from the config.
            template: The template of the data set.

        Yields:
            Lines for the log.
        """
        own, weights = module.state_dict(), self._saved["state_dict"]
        reason = self._new_head(template)
        copied = [key for key in own if reason is None or not key.startswith(HEAD)]
        with torch.no_grad():
            for key in copied:
                own[key].copy_(weights[key])
        layers = ", ".join(dict.fromkeys(key.split(".")[1] for key in copied))
        head = "" if reason is None else f"; new: {HEAD.split('.')[1]} ({reason})"
        yield (
            f"{self.source}: weights of {self._theirs.model.name} trained on "
            f"{self._theirs.data.name}; taken: {layers}{head}"
        )
        if self._different:
            values = (f"{k} {b} (there {a})" for k, (a, b) in self._different.items())
            yield f"{self.source}: other settings than in that run: {', '.join(values)}"

    def _new_head(self, template: Mesh) -> str | None:
        """Why the last layer is not copied; None if it is."""
        try:
            theirs = template_of(self._saved)
        except RunError:
            return "the checkpoint has no template"
        sizes = len(theirs.vertices), len(template.vertices)
        if sizes[0] != sizes[1]:
            return f"its template has {sizes[0]:,} vertices, ours {sizes[1]:,}"
        if not np.array_equal(theirs.faces, template.faces):
            return "its template has other faces"
        tolerance = SAME * np.ptp(template.vertices, axis=0).max()
        if not np.allclose(theirs.vertices, template.vertices, rtol=0, atol=tolerance):
            return "its template has other vertices"
        return None

    def _misfits(self, config: TrainConfig | None, in_features: int) -> float:
        """The number of tensors, the last layer's apart, that differ in shape or are missing."""
        if config is None:
            return float("inf")
        with torch.random.fork_rng(devices=[]):  # the network of the run draws its own weights
            network = build_network(config, in_features, 1)
        shapes = _shapes({f"net.{key}": value for key, value in network.state_dict().items()})
        theirs = _shapes(self._saved["state_dict"])
        return sum(shapes.get(key) != theirs.get(key) for key in shapes.keys() | theirs.keys())

    def _channels_with_theirs(self, key: str) -> int | None:
        config = self._with_theirs(key)
        return config and Features.of(config.data).channels

    def _with_theirs(self, key: str) -> TrainConfig | None:
        """Our config with one setting as in the other run; None if it cannot have it."""
        values: dict[str, Any] = self._config.model_dump()
        *groups, name = key.split(".")
        group = values
        for part in groups:
            group = group[part]
        group[name] = self._different[key][0]
        if key == "neighbourhood.seq_len":
            values["seq_len"] = group[name]
        try:
            return read_stored_config(values)
        except ConfigError:
            return None

    def _misfit(self, keys: list[str]) -> RunError:
        values = (f"{k} must be {a}, got {b}" for k, (a, b) in self._different.items() if k in keys)
        reason = "; ".join(values) or "its weights are of another version of the network"
        return RunError(f"{self.source} does not fit: {reason}")


def checkpoint_of(init: str) -> Path:
    """The checkpoint that `init` names.

    Raises:
        RunError: There is none.
    """
    if init == BUNDLED:
        return BUNDLED_RUN / BEST
    path = Path(init).expanduser()
    if path.is_file():
        return path
    if not path.is_dir():
        raise RunError(f"init must be a run folder, a checkpoint or {BUNDLED}, got {init}")
    if not (path / BEST).is_file():
        what = "no epoch has finished" if (path / CONFIG).is_file() else "it is no run"
        raise RunError(f"init={init} has no {BEST}: {what}")
    return path / BEST


def _settings_of_weights(config: TrainConfig) -> dict[str, Any]:
    """The settings on which weights depend, by their keys."""
    data = {"features", *config.data.features}
    return flat(config.model_dump(include={"model": True, "neighbourhood": True, "data": data}))


def _shapes(weights: dict[str, Tensor]) -> dict[str, torch.Size]:
    return {key: value.shape for key, value in weights.items() if not key.startswith(HEAD)}
