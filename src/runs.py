"""The folder of a run: what lies in it, and going on with it."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from src.config import flat

CONFIG, METRICS = "config.yaml", "metrics.json"
BEST, LAST = "checkpoints/best.ckpt", "checkpoints/last.ckpt"
# what may differ when a run is continued: how and where it is computed
MAY_CHANGE = ("trainer", "data.cache_dir", "data.workers", "picture")


class RunError(ValueError):
    """A folder that is no run, or one that can't be continued as asked."""


class Stopped(BaseException):
    """Ctrl-C or SIGTERM. The message says how to go on."""

    def __init__(self, signum: int, message: str = "Stopped."):
        super().__init__(message)
        self.signum = signum


def write_whole(path: Path, text: str) -> None:
    """Write a file that appears whole or not at all."""
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text)
    os.replace(temporary, path)


def claim(folder: Path, config: DictConfig) -> None:
    """Make a folder that of a run with this config.

    A folder that is so already may be claimed again: the run goes on. Errors: RunError if it holds
    a run with another config.
    """
    path = folder / CONFIG
    if path.exists():
        if different := differences(config, _load(folder)):
            raise RunError(
                f"{folder} holds another run ({', '.join(different[:3])} differ); "
                "choose another folder, or go on with that run with resume="
            )
        return
    write_whole(path, OmegaConf.to_yaml(config, resolve=True))


def differences(config: DictConfig, stored: DictConfig) -> list[str]:
    """The keys in which two configs would make two different runs."""
    one, two = (flat(OmegaConf.to_container(c, resolve=True)) for c in (config, stored))
    keys = [key for key in one.keys() | two.keys() if key != "resume" and not _may_change(key)]
    return sorted(key for key in keys if one.get(key) != two.get(key))


def write_metrics(folder: Path, metrics: dict[str, Any]) -> None:
    """metrics.json, flat. The names are in the README."""
    write_whole(folder / METRICS, json.dumps(metrics, indent=2) + "\n")


def continued(config: DictConfig, overrides: list[str]) -> DictConfig:
    """The config of the run in config.resume, with what this command line may change of it.

    config: composed from this command line. overrides: the command line's key=value words.
    Errors: RunError if the folder is no run, or if an override contradicts the run.
    """
    folder = Path(config.resume)
    stored = _load(folder)
    for override in overrides:
        key = override.lstrip("+~").split("=")[0]
        if key == "resume":
            continue
        if key == "experiment":  # it may set anything
            contradicts = bool(differences(config, stored))
        else:
            new, old = _plain(config, key), _plain(stored, key)
            contradicts = new != old and not _may_change(key)
        if contradicts:
            raise RunError(
                f"{override} contradicts the run in {folder}; leave it out to go on with the run, "
                f"or leave out resume= to start another. Free to change: {', '.join(MAY_CHANGE)}"
            )
        if _may_change(key):
            OmegaConf.update(stored, key, new)
    stored.resume = None
    return stored


def _load(folder: Path) -> DictConfig:
    if not folder.is_dir():
        raise RunError(f"resume={folder}: is not a folder")
    if not (folder / CONFIG).is_file():
        raise RunError(f"resume={folder}: holds no {CONFIG}: it is no run")
    try:
        stored = OmegaConf.load(folder / CONFIG)
    except Exception as error:  # whatever YAML says of a damaged file
        raise RunError(f"{folder / CONFIG} can't be read: {str(error).splitlines()[0]}") from error
    if not isinstance(stored, DictConfig):
        raise RunError(f"{folder / CONFIG} is no config")
    return stored


def _may_change(key: str) -> bool:
    return any(key == free or key.startswith(free + ".") for free in MAY_CHANGE)


def _plain(config: DictConfig, key: str) -> Any:
    node = OmegaConf.select(config, key)
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
