"""A run folder: the names of its files, how to read and write them, and what ends a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from meshspiral.data.files import write_file
from meshspiral.experiment.schema import (
    ConfigError,
    MissingPluginError,
    TrainConfig,
    read_stored_config,
)

CONFIG, METRICS = "config.yaml", "metrics.json"
BEST, LAST = "checkpoints/best.ckpt", "checkpoints/last.ckpt"
ERRORS = "errors.npz"


class Stopped(BaseException):
    """The run was asked to stop, by Ctrl-C or SIGTERM.

    Args:
        signum: Number of the signal.
        message: What to tell the user, e.g. how to resume.
    """

    def __init__(self, signum: int, message: str = "Stopped."):
        super().__init__(message)
        self.signum = signum


class RunError(ValueError):
    """A folder that is not a run, a file of it that is damaged, or a run that cannot be resumed."""


def write_config(folder: Path, config: TrainConfig) -> None:
    """Write config.yaml."""
    write_file(folder / CONFIG, OmegaConf.to_yaml(OmegaConf.create(config.model_dump())))


def write_metrics(folder: Path, metrics: dict[str, Any]) -> None:
    """Write metrics.json, a flat dictionary."""
    write_file(folder / METRICS, json.dumps(metrics, indent=2) + "\n")


def read_metrics(folder: Path) -> dict[str, float]:
    """The metrics of a finished run.

    Raises:
        RunError: The run is not finished, or its metrics.json is damaged.
    """
    path = folder / METRICS
    if not path.is_file():
        raise RunError(f"{folder}: not finished, there is no {METRICS}")
    try:
        metrics = json.loads(path.read_text())
        numbers = all(isinstance(value, int | float) for value in metrics.values())
    except (ValueError, AttributeError, OSError) as error:
        raise RunError(f"{path} is damaged ({error})") from error
    if not numbers or "test/exact_match" not in metrics:
        raise RunError(f"{path} is damaged (metrics are missing)")
    return metrics


def read_run_config(folder: Path) -> TrainConfig:
    """The config of a run of this or an earlier version. Imports no plugins.

    Raises:
        RunError: The folder is not a run, its config is damaged, or it needs a plugin.
    """
    if not folder.is_dir():
        raise RunError(f"{folder} is not a folder")
    path = folder / CONFIG
    if not path.is_file():
        raise RunError(f"{folder} is not a run: it has no {CONFIG}")
    try:
        stored = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
    except Exception as error:  # whatever YAML says of a damaged file
        raise RunError(f"{path} cannot be read ({str(error).splitlines()[0]})") from error
    try:
        return read_stored_config(stored, str(folder))
    except MissingPluginError as error:
        raise RunError(str(error)) from error
    except (ConfigError, AttributeError, KeyError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise RunError(f"{path} is not the config of a run ({reason})") from error
