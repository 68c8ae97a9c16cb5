"""Claiming a run folder, locking it, and resuming its run."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from omegaconf import DictConfig, OmegaConf

from meshspiral.experiment.run_folder import CONFIG, LAST, RunError, read_run_config, write_config
from meshspiral.experiment.schema import TrainConfig, flat, read_config

# how and where a run is computed, which may change when it is resumed
MAY_CHANGE = ("trainer", "data.cache_dir", "data.workers", "data.readers", "picture", "plugins")
# what of a run itself may change when it is resumed: its length, and its start before it began
OF_THE_RUN = ("optim.epochs", "init")
FREE = (*OF_THE_RUN, *MAY_CHANGE)
DEVICE = ("trainer.accelerator", "trainer.devices", "trainer.strategy")  # what trainer= changes

log = logging.getLogger(__name__)


class InUse(RunError):
    """Another process is training in the folder."""


def claim(folder: Path, config: TrainConfig) -> None:
    """Make a folder the run folder of a config. Claiming it again resumes the run.

    Raises:
        RunError: The folder holds a run with another config.
    """
    if (folder / CONFIG).exists():
        if different := differences(config, read_run_config(folder)):
            keys = ", ".join(different[:3])
            raise RunError(
                f"{folder} holds another run, whose {keys} differ; choose another folder, or "
                "resume that run with resume="
            )
        return
    write_config(folder, config)


def is_first() -> bool:
    """Whether this is the first of a run's processes, by the variables that launchers set."""
    return not any(int(os.environ.get(key, 0)) for key in ("RANK", "LOCAL_RANK", "SLURM_PROCID"))


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Hold the lock of a run folder. The system releases the lock of a killed process.

    Raises:
        InUse: Another process holds it.
    """
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


def is_locked(folder: Path) -> bool:
    """Whether another process is training in a folder."""
    try:
        with alone(folder):
            return False
    except InUse:
        return True


def differences(config: TrainConfig, stored: TrainConfig) -> list[str]:
    """The keys in which two configs describe different runs.

    A setting of a descriptor that is to be fitted does not differ from one that was fitted.
    """
    from meshspiral.data.descriptors import Features  # imports torch, which takes seconds

    one, two = (flat(c.model_dump()) for c in (config, stored))
    keys = [key for key in one.keys() | two.keys() if key != "resume" and not may_change(key)]
    fitted = {f"data.{d.name}.{d.fitted}" for d in Features.of(config.data).descriptors}
    fitted = {key for key in fitted if one.get(key) is None}
    return sorted(key for key in keys if one.get(key) != two.get(key) and key not in fitted)


def resumed_config(config: TrainConfig, overrides: list[str]) -> TrainConfig:
    """The config of the run in `config.resume`, with what this command line may change.

    Args:
        config: Composed from this command line.
        overrides: The command line's key=value words.

    Raises:
        RunError: The folder is not a run, or an override contradicts the run.
    """
    folder = Path(config.resume)
    if not folder.is_dir():
        raise RunError(f"resume={folder}: is not a folder")
    stored = read_run_config(folder)
    result, new = (OmegaConf.create(c.model_dump()) for c in (stored, config))
    keys = [override.lstrip("+~").split("=")[0] for override in overrides]
    allowed = [key for key in OF_THE_RUN if key in keys]
    different = [key for key in differences(config, stored) if key not in allowed]
    for key, override in zip(keys, overrides, strict=True):
        if key == "resume":
            continue
        if key in ("experiment", "variant"):  # such a file may set anything
            contradicts = bool(different)
        else:
            group = key.replace("/", ".")  # data/remesh=mixed sets data.remesh
            contradicts = any(f"{other}.".startswith(f"{group}.") for other in different)
        if contradicts:
            raise RunError(
                f"{override} contradicts the run in {folder}; leave it out to resume the run, or "
                f"leave out resume= to start another. Free to change: {', '.join(FREE)}"
            )
        if key == "init" and config.init != stored.init and (folder / LAST).is_file():
            log.warning(
                "init=%s is ignored: the run in %s has checkpoints, and goes on from these. To "
                "train from other weights, start another run, without resume=",
                config.init,
                folder,
            )
        elif key == "trainer":  # the run keeps its precision, threads and validations
            for part in DEVICE:
                OmegaConf.update(result, part, _value(new, part))
        elif may_change(key, resumed=True):
            OmegaConf.update(result, key, _value(new, key))
    result.resume = None
    return read_config(TrainConfig, result)


def may_change(override: str, resumed: bool = False) -> bool:
    """Whether a key, or a key=value word, may differ from the config in a run folder.

    Args:
        override: The key or word.
        resumed: Whether the user names the run, with resume=, and so may also change the run.
    """
    key = override.lstrip("+~").split("=")[0]
    allowed = FREE if resumed else MAY_CHANGE
    return any(key == free or key.startswith(free + ".") for free in allowed)


def _value(config: DictConfig, key: str) -> Any:
    node = OmegaConf.select(config, key)
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
