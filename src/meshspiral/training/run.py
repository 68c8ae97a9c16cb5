"""One run: train, test, and write the results into the run folder."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator
from pathlib import Path

import lightning as L
import torch

from meshspiral.data.datamodule import CorrespondenceData
from meshspiral.data.sources import open_data
from meshspiral.evaluation import summary
from meshspiral.evaluation.outcome import Outcome, evenly
from meshspiral.experiment.run_folder import BEST, ERRORS, LAST, write_metrics
from meshspiral.experiment.schema import TrainConfig, flat
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.training.callbacks import Convergence, Speed
from meshspiral.training.initial import InitialWeights
from meshspiral.training.memory import estimate_memory, free_bytes_on, memory_lines
from meshspiral.training.module import Correspondence
from meshspiral.training.resume import Progress, check_checkpoint, store_changes
from meshspiral.training.trainer import build_trainer

log = logging.getLogger(__name__)


def train(config: TrainConfig, folder: Path) -> dict[str, float]:
    """Train and test in a run folder; resume if it has a checkpoint.

    Returns:
        The content of metrics.json.

    Raises:
        RunError: A checkpoint is damaged, of another run, or does not fit.
        ConfigError: This machine lacks the device.
        DataError, MeshError: The data set cannot be used.
    """
    log.info("run folder: %s", folder)
    last = folder / LAST if (folder / LAST).exists() else None
    data = open_data(config)
    config = config.model_copy(update={"data": data.features.settings_in(config.data)})
    initial = InitialWeights(config, data.in_features) if config.init and last is None else None
    began = time.perf_counter()
    data.prepare()
    seconds = time.perf_counter() - began

    L.seed_everything(config.seed, verbose=False)
    module = Correspondence(config.model_dump(), data.in_features, data.num_classes)
    speed, convergence = Speed(), Convergence()
    trainer = build_trainer(config, folder, speed, convergence)
    data.check_sizes(trainer.world_size)
    parameters = sum(p.numel() for p in module.parameters() if p.requires_grad)
    for line in description_lines(config, data, parameters, trainer.precision, seconds):
        log.info(line)
    for line in initial.load_into(module, data.shapes.template) if initial else ():
        log.info(line)

    estimate = estimate_memory(module.net, data, trainer.precision)
    device = trainer.strategy.root_device
    for level, line in memory_lines(estimate, free_bytes_on(device), device.type):
        log.log(level, line)

    progress = None
    if last:
        if (folder / BEST).exists():
            check_checkpoint(folder / BEST, config, trainer.world_size)
        saved = check_checkpoint(last, config, trainer.world_size)
        data.check_checkpoint(saved)
        meshes = math.ceil(len(data.datasets["train"]) / trainer.world_size)
        steps = math.ceil(meshes / config.trainer.accumulate)
        progress = Progress.of(saved, config, steps)
        log.info(progress.line(folder))
    if trainer.is_global_zero:
        store_changes(folder, config, progress)
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
        "seconds/wait": speed.waiting,
    }
    if convergence.exact:  # empty if an earlier version trained all epochs
        metrics["epochs/to_90_percent"] = convergence.epochs_to(0.9)
    if trainer.is_global_zero:
        trainer.logger.log_hyperparams(flat(config.model_dump()), tested)
        trainer.logger.finalize("success")
        outcome = Outcome.of(
            data.shapes.names["test"],
            data.datasets["test"],
            module.results["test"],
            data.reference.diameter,
        )
        outcome.save(folder / ERRORS)
        if (error := outcome.error_to_label) is not None:
            metrics["test/geodesic_error_to_label"] = error
        chosen = evenly(outcome.names, 4) if config.picture else []
        summary.write_plots(folder, module.curves, outcome, data, chosen)
        write_metrics(folder, metrics)  # the last file: now the run is finished
        for line in summary.metric_lines(outcome, metrics):
            log.info(line)
        log.info(
            "Seconds:     %.1f preprocessing, %.1f training, of it %.1f waiting for meshes",
            seconds,
            speed.seconds,
            speed.waiting,
        )
        log.info("Run folder:  %s", folder)
        log.info("TensorBoard: tensorboard --logdir %s", folder)
    return metrics


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
    yield f"cache: {data.cache.root}; ready after {seconds:.1f} s"
