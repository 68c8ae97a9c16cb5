"""Resuming a run, also for more epochs than it had."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from meshspiral.data.descriptors import Features
from meshspiral.experiment.run_folder import (
    CONFIG,
    METRICS,
    RunError,
    read_run_config,
    write_config,
)
from meshspiral.experiment.schema import TrainConfig, flat
from meshspiral.training.checkpoints import config_of, read_checkpoint
from meshspiral.training.module import rate_factor


def check_checkpoint(checkpoint: Path, config: TrainConfig, processes: int) -> dict[str, Any]:
    """Read a checkpoint that is to be resumed with a config.

    Returns:
        Its content.

    Raises:
        RunError: It is damaged, of another network, of a run in another number of processes or with
            another `trainer.accumulate`, or of a later epoch than the config has.
    """
    try:
        saved = read_checkpoint(checkpoint)
    except RunError as error:
        raise RunError(f"{error}; delete the run's checkpoints to start it anew") from error
    groups = ("model", "neighbourhood")
    theirs = flat(config_of(saved, str(checkpoint)).model_dump(include=set(groups)))
    for key, value in flat(config.model_dump(include=set(groups))).items():
        if theirs.get(key) != value:
            raise RunError(
                f"{checkpoint} is of another run: {key} must be {value}, got {theirs.get(key)}"
            )
    if saved.get("processes", processes) != processes:
        raise RunError(
            f"{checkpoint} is of a run in {saved['processes']} processes, not {processes}: resume "
            "it with the same trainer.devices"
        )
    accumulate = config_of(saved, str(checkpoint)).trainer.accumulate
    if accumulate != config.trainer.accumulate:
        raise RunError(
            f"{checkpoint} is of a run with trainer.accumulate={accumulate}, not "
            f"{config.trainer.accumulate}: resume it with the same"
        )
    begun = saved["epoch"] + 1
    if config.optim.epochs < begun:
        raise RunError(
            f"optim.epochs must be at least {begun}, the number of epochs that the run in "
            f"{checkpoint.parents[1]} has begun, got {config.optim.epochs}"
        )
    return saved


@dataclass(frozen=True)
class Progress:
    """How far a run got.

    Attributes:
        step: Number of steps done.
        steps: Number of steps of an epoch.
        earlier: Number of epochs that the run had until now.
        config: The config to resume it with.
    """

    step: int
    steps: int
    earlier: int
    config: TrainConfig

    @staticmethod
    def of(saved: dict[str, Any], config: TrainConfig, steps: int) -> Progress:
        """The progress of a checkpoint, from `check_checkpoint`."""
        return Progress(saved["global_step"], steps, config_of(saved).optim.epochs, config)

    def line(self, folder: Path) -> str:
        """What is going to happen."""
        optim = self.config.optim
        total = optim.epochs * self.steps
        epochs = f"{optim.epochs} epoch{'s' * (optim.epochs > 1)}"
        if self.step >= total:
            if not (folder / METRICS).exists():
                return f"all {epochs} are trained; only the test is left"
            return (
                f"the run is finished: its {epochs} are trained, so it is only tested again. To "
                f"train longer, add optim.epochs= with more than {optim.epochs}"
            )
        done = f"resuming after {self.step / self.steps:.3g} of {epochs}"
        if optim.epochs == self.earlier:
            return done
        rate = optim.lr * rate_factor(optim, self.step, total)
        course = (
            f"stays {rate:.3g}"
            if optim.schedule == "constant"
            else f"is now {rate:.3g} and follows the {optim.schedule} of {epochs}"
        )
        return f"{done}, until now {self.earlier}; the learning rate {course}"

    @property
    def extended(self) -> bool:
        """Whether the run is to have another number of epochs than until now."""
        return self.config.optim.epochs != self.earlier


def store_changes(folder: Path, config: TrainConfig, progress: Progress | None = None) -> None:
    """Write what a run folder's config must say from now on: `optim.epochs`, `init`, and settings
    of descriptors that were fitted.

    The metrics of a finished run that is trained longer are kept under another name: the run is no
    longer finished.
    """
    if progress and progress.extended and (folder / METRICS).exists():
        (folder / METRICS).rename(folder / f"metrics_{progress.earlier}_epochs.json")
    if (folder / CONFIG).exists():
        stored = read_run_config(folder)
        data = Features.of(config.data).settings_in(stored.data)
        changes = {"optim": config.optim, "init": config.init, "data": data}
        changed = stored.model_copy(update=changes)
        if changed != stored:
            write_config(folder, changed)
