"""Train a network and test it: `python -m src.train`, `python -m src.train --help`."""

from __future__ import annotations

import contextlib
import logging
import os
import shlex
import subprocess
import sys
from pathlib import Path

from meshspiral.experiment.entry import entry_point
from meshspiral.experiment.program import command_line, module_of
from meshspiral.experiment.run_folder import METRICS, RunError, Stopped, read_run_config
from meshspiral.experiment.runs import (
    InUse,
    alone,
    claim,
    is_first,
    is_locked,
    may_change,
    resumed_config,
)
from meshspiral.experiment.schema import TrainConfig, TrainerSettings

log = logging.getLogger(__name__)


@entry_point("train", TrainConfig)
def main(config: TrainConfig) -> None:
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    from meshspiral.training.run import train

    hydra = HydraConfig.get()
    overrides = list(hydra.overrides.task)
    folder = Path(hydra.runtime.output_dir)
    if folder.is_relative_to(Path.cwd()):  # shorter to read and to type
        folder = folder.relative_to(Path.cwd())
    if config.resume:
        folder = Path(config.resume)
        config = resumed_config(config, overrides)
    else:
        claim(folder, config)
    in_sweep = hydra.mode == RunMode.MULTIRUN
    separate = in_sweep and not is_one_process(config.trainer)
    try:
        with alone(folder) if is_first() else contextlib.nullcontext():
            if in_sweep and is_finished(folder, config):
                log.info("already finished: %s", folder)
                return
            if not separate:
                train(config, folder)
        if separate:
            words = [word for word in overrides if may_change(word, resumed=True)]
            train_separately(folder, [*words, *trainer_words(config.trainer)])
    except InUse:
        if not in_sweep:
            raise
        log.info("already running in another process: %s", folder)
    except Stopped as stopped:
        if not is_first():
            sys.exit()  # with another exit code, Lightning would kill the first process
        resume = f"{command_line('train')} {shlex.quote(f'resume={folder}')}"
        message = "Stopped." if in_sweep else f"Stopped. To resume: {resume}"
        raise Stopped(stopped.signum, message) from None


def is_one_process(trainer: TrainerSettings) -> bool:
    """Whether Lightning certainly trains in this process alone."""
    return trainer.strategy == "auto" and trainer.devices in (1, "1")


def trainer_words(trainer: TrainerSettings) -> list[str]:
    """The key=value words that set all of a trainer's settings, also those from a file."""
    values = trainer.model_dump().items()
    return [f"trainer.{key}={'null' if value is None else value}" for key, value in values]


def is_finished(folder: Path, config: TrainConfig) -> bool:
    """Whether a run has metrics, and is not to have other epochs now."""
    epochs = config.optim.epochs
    return (folder / METRICS).is_file() and read_run_config(folder).optim.epochs == epochs


def train_separately(folder: Path, overrides: list[str]) -> None:
    """Train a job of a sweep that takes several processes, by a command line of its own.

    Lightning starts the other processes with the command line of this one, which would run the
    whole sweep again.

    Args:
        folder: The run folder.
        overrides: What this command line says of how and where the run is computed.

    Raises:
        RunError: The run failed.
        InUse: Another process is training in the folder.
    """
    command = [sys.executable, "-m", module_of("train"), f"resume='{folder}'", *overrides]
    # Lightning would take the size of a cluster's job as the number of processes
    environment = {k: v for k, v in os.environ.items() if not k.startswith("SLURM_")}
    process = subprocess.Popen(command, env=environment, start_new_session=True)
    try:
        code = process.wait()
    except Stopped as stopped:
        process.send_signal(stopped.signum)  # once, and to this process alone
        process.wait()
        raise
    if code and is_locked(folder):
        raise InUse(f"another process is training in {folder}")
    if code:
        raise RunError(
            f"training ended with exit code {code}; the reason is in {folder}/train*.log"
        )


if __name__ == "__main__":
    main()
