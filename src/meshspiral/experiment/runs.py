"""The folder of a run: what lies in it, and going on with it."""

from __future__ import annotations

import contextlib
import io
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from meshspiral.experiment.schema import ConfigError, checked, flat

CONFIG, METRICS = "config.yaml", "metrics.json"
BEST, LAST = "checkpoints/best.ckpt", "checkpoints/last.ckpt"
# what may differ when a run is continued: how and where it is computed
MAY_CHANGE = ("trainer", "data.cache_dir", "data.workers", "picture")


class RunError(ValueError):
    """A folder that is no run, or one that can't be continued as asked."""


class InUse(RunError):
    """Another process is training in the folder."""


class Stopped(BaseException):
    """Ctrl-C or SIGTERM. The message says how to go on."""

    def __init__(self, signum: int, message: str = "Stopped."):
        super().__init__(message)
        self.signum = signum


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file that appears whole or not at all."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    temporary.write_bytes(content if isinstance(content, bytes) else content.encode())
    os.replace(temporary, path)


def write_arrays(path: Path, **arrays: np.ndarray) -> None:
    """A .npz file that appears whole or not at all."""
    whole = io.BytesIO()
    np.savez_compressed(whole, **arrays)
    write_whole(path, whole.getvalue())


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


def is_first() -> bool:
    """Whether this is the first of a run's processes, as those who start them say."""
    return not any(int(os.environ.get(key, 0)) for key in ("RANK", "LOCAL_RANK", "SLURM_PROCID"))


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """While this process trains there no other does; the system lets go of what a killed one held.
    Errors: InUse."""
    lock = FileLock(folder / ".lock", timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise InUse(f"another process is training in {folder}") from error
    except (NotImplementedError, OSError):  # a file system without locks
        pass
    try:
        yield
    finally:
        lock.release()


def in_use(folder: Path) -> bool:
    """Whether another process is training there."""
    try:
        with alone(folder):
            return False
    except InUse:
        return True


def differences(config: DictConfig, stored: DictConfig) -> list[str]:
    """The keys in which two configs would make two different runs."""
    one, two = (flat(OmegaConf.to_container(c, resolve=True)) for c in (config, stored))
    keys = [key for key in one.keys() | two.keys() if key != "resume" and not may_change(key)]
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
            contradicts = any(
                f"{other}.".startswith(f"{key}.") for other in differences(config, stored)
            )
        if contradicts:
            raise RunError(
                f"{override} contradicts the run in {folder}; leave it out to go on with the run, "
                f"or leave out resume= to start another. Free to change: {', '.join(MAY_CHANGE)}"
            )
        if may_change(key):
            OmegaConf.update(stored, key, _plain(config, key))
    stored.resume = None
    return stored


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What a checkpoint holds, by names. Nothing in it is executed.

    Errors: RunError if the file is not there, or is no whole checkpoint of this program.
    """
    import torch

    if not path.is_file():
        what = "no finished epoch" if (path.parents[1] / CONFIG).is_file() else "no run"
        raise RunError(f"{path.parents[1]} holds no {BEST}: it is {what}")
    try:
        saved = torch.load(path, weights_only=True, map_location="cpu", mmap=True)
        if not {"config", "in_features", "num_classes"} <= saved["hyper_parameters"].keys():
            raise KeyError("its hyper-parameters")
    except Exception as error:  # whatever a damaged file makes torch say
        reason = (str(error).splitlines() or [repr(error)])[0][:100]
        raise RunError(f"{path} is damaged ({reason})") from error
    return saved


def stored_config(folder: Path) -> dict[str, Any]:
    """The whole config of a run, in plain containers. Errors: RunError if it is not one."""
    return OmegaConf.to_container(_load(folder))


def _load(folder: Path) -> DictConfig:
    if not folder.is_dir():
        raise RunError(f"resume={folder}: is not a folder")
    if not (folder / CONFIG).is_file():
        raise RunError(f"{folder} holds no {CONFIG}: it is no run")
    try:
        stored = OmegaConf.load(folder / CONFIG)
    except Exception as error:  # whatever YAML says of a damaged file
        raise RunError(f"{folder / CONFIG} can't be read: {str(error).splitlines()[0]}") from error
    try:
        return checked(stored)  # with what has been added to the settings since then
    except (ConfigError, OmegaConfBaseException, AttributeError, KeyError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise RunError(f"{folder / CONFIG} is no config of a run ({reason})") from error


def may_change(override: str) -> bool:
    """Whether a key, or a key=value of the command line, may differ when a run is continued."""
    key = override.lstrip("+~").split("=")[0]
    return any(key == free or key.startswith(free + ".") for free in MAY_CHANGE)


def _plain(config: DictConfig, key: str) -> Any:
    node = OmegaConf.select(config, key)
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
