"""Train a network and test it: `python -m src.train`, `python -m src.train --help`."""

from __future__ import annotations

import contextlib
import logging
import os
import shlex
import subprocess
import sys
import time
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from meshspiral.experiment.entry import entry_point
from meshspiral.experiment.runs import (
    BEST,
    LAST,
    METRICS,
    InUse,
    RunError,
    Stopped,
    alone,
    claim,
    continued,
    in_use,
    is_first,
    may_change,
    read_checkpoint,
    write_metrics,
)
from meshspiral.experiment.schema import checked, flat

log = logging.getLogger(__name__)


@entry_point("train", checked)
def main(config: DictConfig) -> None:
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    hydra = HydraConfig.get()
    folder = Path(hydra.runtime.output_dir)
    if folder.is_relative_to(Path.cwd()):  # shorter to read, and to type
        folder = folder.relative_to(Path.cwd())
    if config.resume:
        folder = Path(config.resume)
        config = checked(continued(config, list(hydra.overrides.task)))
    else:
        claim(folder, config)
    in_sweep = hydra.mode == RunMode.MULTIRUN
    apart = in_sweep and config.trainer.strategy != "auto"
    try:
        with alone(folder) if is_first() else contextlib.nullcontext():
            if in_sweep and (folder / METRICS).is_file():
                log.info("finished before: %s", folder)
                return
            if not apart:
                train(config, folder)
        if apart:
            train_apart(folder, [o for o in hydra.overrides.task if may_change(o)])
    except InUse:
        if not in_sweep:
            raise
        log.info("another process is at it: %s", folder)
    except Stopped as stopped:
        if not is_first():
            sys.exit()  # with another code, Lightning would kill the first
        resume = f"python -m src.train {shlex.quote(f'resume={folder}')}"
        how = "the same command" if in_sweep else resume
        raise Stopped(stopped.signum, f"Stopped. To go on: {how}") from None


def train_apart(folder: Path, overrides: list[str]) -> None:
    """A run of a sweep that takes several processes: Lightning starts the others with the command
    line of this one, so it has to be one that runs nothing else.

    overrides: what this command line says of how and where it is computed. Errors: RunError; InUse.
    """
    command = [sys.executable, "-m", "src.train", f"resume='{folder}'", *overrides]
    # of a cluster's job it would take the size, but it starts its processes itself
    environment = {k: v for k, v in os.environ.items() if not k.startswith("SLURM_")}
    process = subprocess.Popen(command, env=environment, start_new_session=True)
    try:
        code = process.wait()
    except Stopped as stopped:
        process.send_signal(stopped.signum)  # and to it alone, once
        process.wait()
        raise
    if code and in_use(folder):
        raise InUse(f"another process is training in {folder}")
    if code:
        raise RunError(f"its processes ended with exit code {code}; why is in {folder}/train*.log")


def train(config: DictConfig, folder: Path) -> dict[str, float]:
    """Train and test as the config says, in a run folder; go on where it left off if it holds a
    checkpoint. Returns what metrics.json holds."""
    import lightning as L

    from meshspiral.data.sources import open_data
    from meshspiral.evaluation import summary
    from meshspiral.evaluation.outcome import ERRORS, Outcome, evenly
    from meshspiral.training.callbacks import Speed
    from meshspiral.training.module import Correspondence
    from meshspiral.training.trainer import build_trainer

    log.info("run folder: %s", folder)
    plain = OmegaConf.to_container(config)
    data = open_data(plain)
    began = time.perf_counter()
    data.prepare()
    seconds = time.perf_counter() - began

    L.seed_everything(config.seed, verbose=False)
    module = Correspondence(plain, data.in_features, data.num_classes)
    speed = Speed()
    trainer = build_trainer(config, folder, speed)
    parameters = sum(p.numel() for p in module.parameters() if p.requires_grad)
    for line in describe(config, data, parameters, trainer.precision, seconds):
        log.info(line)

    last = folder / LAST if (folder / LAST).exists() else None
    for checkpoint in (last, folder / BEST):
        if last and checkpoint.exists():
            check(checkpoint, plain, trainer.world_size)
    trainer.fit(module, datamodule=data, weights_only=True, ckpt_path=last)
    [tested] = trainer.test(
        module, datamodule=data, ckpt_path=folder / BEST, weights_only=True, verbose=False
    )
    metrics = {
        **tested,
        **module.figures["val"],  # of best.ckpt, to choose settings by
        "parameters": parameters,
        "seconds/preprocess": seconds,
        "seconds/train": speed.seconds,
    }
    if trainer.is_global_zero:
        trainer.logger.log_hyperparams(flat(plain), tested)
        trainer.logger.finalize("success")
        outcome = Outcome.of(
            data.shapes.names["test"],
            data.datasets["test"].items,
            module.results["test"],
            data.reference.diameter,
        )
        outcome.save(folder / ERRORS)
        chosen = evenly(outcome.names, 4) if config.picture else []
        summary.draw(folder, module.curves, outcome, data, chosen)
        write_metrics(folder, metrics)  # with it, a run is finished
        for line in summary.table(outcome, metrics):
            log.info(line)
        log.info("Seconds:     %.1f preprocessing, %.1f training", seconds, speed.seconds)
        log.info("Run folder:  %s", folder)
        log.info("TensorBoard: tensorboard --logdir %s", folder)
    return metrics


def check(checkpoint: Path, config: dict, processes: int) -> None:
    """Errors: RunError if a checkpoint can't be read, is of another network, or of a run in another
    number of processes, whose epochs have another number of steps."""
    try:
        saved = read_checkpoint(checkpoint)
    except RunError as error:
        raise RunError(f"{error}; without its checkpoints the run begins anew") from error
    theirs = OmegaConf.to_container(checked(OmegaConf.create(saved["hyper_parameters"]["config"])))
    for key in ("model", "seq_len"):
        if theirs[key] != config[key]:
            raise RunError(f"{checkpoint} is of another run: its {key} is {theirs[key]}")
    if saved.get("processes", processes) != processes:
        raise RunError(
            f"{checkpoint} is of a run in {saved['processes']} processes, this would be "
            f"{processes}: go on with the same trainer.devices"
        )


def describe(config: DictConfig, data, parameters: int, precision: str, seconds: float):
    """What is about to be trained, on what, and where its input is kept."""
    import torch

    sizes = [len(data.shapes.names[split]) for split in ("train", "val", "test")]
    made = f", remeshed ({config.data.remesh.policy})" if config.data.remesh else ""
    yield (
        f"{config.data.name}{made}: {sizes[0]} meshes to train on, {sizes[1]} to validate, "
        f"{sizes[2]} to test; labels are the {data.num_classes} vertices of the template"
    )
    yield (
        f"{config.model.name}: {parameters:,} parameters, {neighbourhoods(config)}; "
        f"{config.optim.epochs} epochs, {precision} on {config.trainer.accelerator}, "
        f"{torch.get_num_threads()} thread{'s' * (torch.get_num_threads() > 1)}"
    )
    megabytes = data.store.size() / 1e6
    yield f"cache: {data.store.root}, {megabytes:.0f} MB; ready after {seconds:.1f} s"


def neighbourhoods(config: DictConfig) -> str:
    """What the network sees around a vertex."""
    if "patch" in config.model:
        patch = config.model.patch
        return f"patches of {patch.rings} x {patch.rays} samples, radius {patch.radius} diameters"
    rings = config.model.get("rings")
    spirals = f"{rings} rings" if rings else f"{config.seq_len} vertices"
    return f"spirals of {spirals} {'with' if config.model.metric else 'without'} metric information"


if __name__ == "__main__":
    main()
