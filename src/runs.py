"""The folder of a run: what lies in it, and going on with it."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

CONFIG, METRICS = "config.yaml", "metrics.json"
BEST, LAST = "checkpoints/best.ckpt", "checkpoints/last.ckpt"
# what may differ when a run is continued: how and where it is computed, and for how long
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


def write_config(folder: Path, config: DictConfig) -> None:
    write_whole(folder / CONFIG, OmegaConf.to_yaml(config, resolve=True))


def write_metrics(folder: Path, metrics: dict[str, Any]) -> None:
    """metrics.json, flat. The names are in the README."""
    write_whole(folder / METRICS, json.dumps(metrics, indent=2) + "\n")


def continued(config: DictConfig, overrides: list[str]) -> DictConfig:
    """The config of the run in config.resume, with what this command line may change of it.

    config: composed from this command line. overrides: the command line's key=value words.
    Errors: RunError if the folder is no run, or if an override contradicts the run.
    """
    folder = Path(config.resume)
    try:
        stored = OmegaConf.load(folder / CONFIG)
        OmegaConf.set_struct(stored, False)
    except FileNotFoundError as error:
        what = "is not a folder" if not folder.is_dir() else f"holds no {CONFIG}: it is no run"
        raise RunError(f"resume={config.resume}: {what}") from error
    except (OSError, ValueError, OmegaConfBaseException, Exception) as error:
        raise RunError(f"{folder / CONFIG} can't be read: {str(error).splitlines()[0]}") from error
    for override in overrides:
        key = override.lstrip("+~").split("=")[0]
        if key in ("resume", "experiment"):
            continue
        new, old = OmegaConf.select(config, key), OmegaConf.select(stored, key)
        if _plain(new) == _plain(old):
            continue
        if not any(key == k or key.startswith(k + ".") for k in MAY_CHANGE):
            raise RunError(
                f"{override} contradicts the run in {folder} ({key}={old}); leave it out to go on "
                f"with the run, or leave out resume= to start another. Free to change are: "
                f"{', '.join(MAY_CHANGE)}"
            )
        OmegaConf.update(stored, key, new)
    stored.resume = None
    return stored


def _plain(node: Any) -> Any:
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
