"""One run: train, test, and write the results into the run folder."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from pathlib import Path

import lightning as L
import torch

from meshspiral.data.datamodule import CorrespondenceData
from meshspiral.data.sources import open_data
from meshspiral.evaluation import summary
from meshspiral.evaluation.outcome import Outcome, evenly
from meshspiral.experiment.run_folder import BEST, ERRORS, LAST, RunError, write_metrics
from meshspiral.experiment.schema import TrainConfig, flat
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.training.callbacks import Speed
from meshspiral.training.checkpoints import config_of, read_checkpoint
from meshspiral.training.module import Correspondence
from meshspiral.training.trainer import build_trainer

log = logging.getLogger(__name__)


def train(config: TrainConfig, folder: Path) -> dict[str, float]:
    """Train and test in a run folder; resume if it has a checkpoint.

    Returns:
        The content of metrics.json.

    Raises:
        RunError: A checkpoint is damaged, or of another run.
        ConfigError: This machine lacks the device.
        DataError, MeshError: The data set cannot be used.
    """
    log.info("run folder: %s", folder)
    data = open_data(config)
    began = time.perf_counter()
    data.prepare()
    seconds = time.perf_counter() - began

    L.seed_everything(config.seed, verbose=False)
    module = Correspondence(config.model_dump(), data.in_features, data.num_classes)
    speed = Speed()
    trainer = build_trainer(config, folder, speed)
    parameters = sum(p.numel() for p in module.parameters() if p.requires_grad)
    for line in description_lines(config, data, parameters, trainer.precision, seconds):
        log.info(line)

    last = folder / LAST if (folder / LAST).exists() else None
    for checkpoint in (last, folder / BEST):
        if last and checkpoint.exists():
            check_checkpoint(checkpoint, config, trainer.world_size)
    trainer.fit(module, datamodule=data, weights_only=True, ckpt_path=last)
    [tested] = trainer.test(
        module, datamodule=data, ckpt_path=folder / BEST, weights_only=True, verbose=False
    )
    metrics = {
        **tested,
        **module.metrics["val"],  # of best.ckpt, to choose settings by
        "parameters": parameters,
        "seconds/preprocess": seconds,
        "seconds/train": speed.seconds,
    }
    if trainer.is_global_zero:
        trainer.logger.log_hyperparams(flat(config.model_dump()), tested)
        trainer.logger.finalize("success")
        outcome = Outcome.of(
            data.shapes.names["test"],
            data.datasets["test"].items,
            module.results["test"],
            data.reference.diameter,
        )
        outcome.save(folder / ERRORS)
        chosen = evenly(outcome.names, 4) if config.picture else []
        summary.write_plots(folder, module.curves, outcome, data, chosen)
        write_metrics(folder, metrics)  # the last file: now the run is finished
        for line in summary.metric_lines(outcome, metrics):
            log.info(line)
        log.info("Seconds:     %.1f preprocessing, %.1f training", seconds, speed.seconds)
        log.info("Run folder:  %s", folder)
        log.info("TensorBoard: tensorboard --logdir %s", folder)
    return metrics


def check_checkpoint(checkpoint: Path, config: TrainConfig, processes: int) -> None:
    """Check that a checkpoint can be resumed with a config.

    Raises:
        RunError: It is damaged, of another network, or of a run in another number of processes,
            whose epochs have another number of steps.
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


def description_lines(
    config: TrainConfig,
    data: CorrespondenceData,
    parameters: int,
    precision: str,
    seconds: float,
) -> Iterator[str]:
    """What is about to be trained, on what, and where the cache is."""
    sizes = [len(data.shapes.names[split]) for split in ("train", "val", "test")]
    remeshed = f", remeshed ({config.data.remesh.policy})" if config.data.remesh else ""
    yield (
        f"{config.data.name}{remeshed}: {sizes[0]} training meshes, {sizes[1]} for validation, "
        f"{sizes[2]} for the test; labels are the {data.num_classes} vertices of the template"
    )
    around = Neighbourhood.of(config.neighbourhood).title
    if (metric := getattr(config.model, "metric", None)) is not None:
        around += f" {'with' if metric else 'without'} metric information"
    threads, epochs = torch.get_num_threads(), config.optim.epochs
    yield (
        f"{config.model.name}: {parameters:,} parameters, {around}; "
        f"{epochs} epoch{'s' * (epochs > 1)}, {precision} on {config.trainer.accelerator}, "
        f"{threads} thread{'s' * (threads > 1)}"
    )
    megabytes = data.cache.size() / 1e6
    yield f"cache: {data.cache.root}, {megabytes:.0f} MB; ready after {seconds:.1f} s"
