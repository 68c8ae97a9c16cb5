"""Composing a config without a command line."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from meshspiral.experiment.schema import TrainConfig, flat, read_config

PACKAGE = Path(__file__).parents[1]
# in a clone conf/ is at its root; an installed package contains a copy
CONF = str(next(p for p in (PACKAGE.parents[1] / "conf", PACKAGE / "conf") if p.is_dir()))


@contextlib.contextmanager
def _fresh_hydra() -> Iterator[None]:
    """Compose without the state of a command that is running."""
    before = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(CONF, version_base="1.3"):
            yield
    finally:
        GlobalHydra.instance().hydra = before


def known_keys(command: str) -> list[str]:
    """What can stand before = on the command line of a command: settings and config groups."""
    with _fresh_hydra():
        tree = OmegaConf.to_container(compose(command))
    groups = {"experiment", "variant"} if command == "train" else set()
    return sorted({*flat(tree), *tree, *groups})


def compose_train(overrides: list[str]) -> TrainConfig:
    """The config that `train` composes from key=value words, for use in Python.

    Raises:
        ConfigError: A setting cannot be used.
        HydraException: A word cannot be parsed, or names no option.
    """
    with _fresh_hydra():
        return read_config(TrainConfig, compose("train", overrides))
