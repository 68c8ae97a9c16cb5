"""Train a network and test it: `python -m src.train`, `python -m src.train --help`."""

from __future__ import annotations

import logging
import time
import warnings
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from src.cli import Stopped, entry_point
from src.runs import (
    BEST,
    LAST,
    continued,
    write_config,
    write_metrics,
)

log = logging.getLogger("src.train")


@entry_point("train")
def main(config: DictConfig) -> None:
    from hydra.core.hydra_config import HydraConfig

    hydra = HydraConfig.get()
    folder = Path(hydra.runtime.output_dir)
    if config.resume:
        folder = Path(config.resume)
        config = continued(config, list(hydra.overrides.task))
    else:
        write_config(folder, config)
    try:
        train(config, folder)
    except Stopped as stopped:
        raise Stopped(
            stopped.signum, f"Stopped. To go on: python -m src.train resume={folder}"
        ) from None


def train(config: DictConfig, folder: Path) -> dict[str, float]:
    """Train and test as the config says, in a run folder; go on where it left off if it holds a
    checkpoint. Returns what metrics.json holds."""
    import lightning as L
    import torch
    from lightning.pytorch.callbacks import LearningRateMonitor, ModelCheckpoint
    from lightning.pytorch.loggers import TensorBoardLogger

    from src.callbacks import Bar, OrderlyStop, Speed, WholeFiles
    from src.correspondence import Correspondence
    from src.data.datamodule import CorrespondenceData
    from src.data.preprocessing import Recipe
    from src.data.sources import open_shapes
    from src.data.store import Store

    quiet()
    plain = OmegaConf.to_container(config)
    torch.set_num_threads(config.trainer.threads or torch.get_num_threads())
    torch.set_flush_denormal(True)  # tiny probabilities would slow the softmax down tenfold
    store = Store(config.data.cache_dir)
    rings = config.model.get("rings")
    recipe = Recipe(config.data.shot.radius, config.data.shot.bins,
                    None if rings else config.seq_len, rings)  # fmt: skip
    data = CorrespondenceData(open_shapes(plain["data"]), recipe, store, config.seed,
                              config.data.shuffle_vertices, config.data.workers)  # fmt: skip
    began = time.perf_counter()
    data.prepare()
    seconds = time.perf_counter() - began

    L.seed_everything(config.seed, verbose=False)
    module = Correspondence(plain, data.in_features, data.num_classes)
    parameters = sum(p.numel() for p in module.parameters() if p.requires_grad)
    precision = choose_precision(config.trainer.precision, config.trainer.accelerator)
    logger = TensorBoardLogger(folder, name="", version="", default_hp_metric=False)
    speed = Speed()
    best = ModelCheckpoint(folder / "checkpoints", "best", monitor="val/geodesic_error",
                           enable_version_counter=False)  # fmt: skip
    last = ModelCheckpoint(folder / "checkpoints", "last", save_on_train_epoch_end=True,
                           enable_version_counter=False)  # fmt: skip
    trainer = L.Trainer(
        accelerator=config.trainer.accelerator,
        devices=config.trainer.devices,
        strategy=config.trainer.strategy,
        precision=precision,
        max_epochs=config.optim.epochs,
        check_val_every_n_epoch=config.trainer.val_every,
        deterministic=config.trainer.accelerator == "cpu",
        logger=logger,
        log_every_n_steps=10,
        num_sanity_val_steps=0,
        enable_model_summary=False,
        plugins=[WholeFiles()],
        callbacks=[Bar(), speed, OrderlyStop(folder), LearningRateMonitor("step"), best, last],
    )
    log.info("%s on %s: %d meshes to train on, %d to validate, %d to test; a template of %d vertices",
             config.model.name, config.data.name, *(len(data.datasets[s]) for s in data.datasets),
             data.num_classes)  # fmt: skip
    log.info("%s parameters; spirals of %s, metric information %s; %s-bit on %s",
             f"{parameters:,}", f"{rings} rings" if rings else f"{config.seq_len} vertices",
             "on" if config.model.metric else "off", precision, config.trainer.accelerator)  # fmt: skip
    log.info("cache %s: %.0f MB; ready after %.1f s", store.root, store.size() / 1e6, seconds)

    checkpoint = folder / LAST
    trainer.fit(module, datamodule=data, weights_only=True,
                ckpt_path=checkpoint if checkpoint.exists() else None)  # fmt: skip
    [tested] = trainer.test(module, datamodule=data, ckpt_path=folder / BEST, weights_only=True,
                            verbose=False)  # fmt: skip
    metrics = {
        **tested,
        "parameters": parameters,
        "seconds/preprocess": seconds,
        "seconds/train": speed.seconds,
    }
    if trainer.is_global_zero:
        logger.log_hyperparams(flat(plain), {k: v for k, v in tested.items()})
        logger.finalize("success")
        write_metrics(folder, metrics)
        show(folder, data, module, metrics, config.picture)
    return metrics


def choose_precision(wanted: str, accelerator: str) -> str:
    """Lightning's name for a precision; auto is bf16 where the hardware multiplies it, else 32."""
    import torch

    if wanted == "auto":
        if accelerator == "cpu":
            native = [getattr(torch.cpu, f"_is_{name}_supported", bool)
                      for name in ("avx512_bf16", "amx_tile")]  # fmt: skip
            wanted = "bf16" if any(check() for check in native) else "32"
        else:
            wanted = "bf16" if torch.cuda.is_available() and torch.cuda.is_bf16_supported() else "32"
    return {"32": "32-true", "64": "64-true", "bf16": "bf16-mixed"}[wanted]


def show(folder: Path, data, module, metrics: dict[str, float], picture: bool) -> None:
    """The curve and the picture of a run, and its figures as a table."""
    from src.figures import curve_figure
    from src.metrics import THRESHOLDS

    names = data.shapes.names["test"]
    curves = {split: (THRESHOLDS, curve) for split, curve in module.curves.items()}
    curve_figure(curves).savefig(folder / "curve.png", dpi=150)
    written = ["curve.png"]
    if picture:
        draw(folder / "correspondence.png", data, module.predictions)
        written.append("correspondence.png")
    vertices = sum(len(p) for p in module.predictions.values())
    lines = [
        f"Test on {len(names)} unseen meshes ({names[0]} .. {names[-1]}), {vertices:,} vertices",
        f"  exact match                          {100 * metrics['test/exact_match']:6.2f} %",
        f"  within 0.01 sqrt(area)               {100 * metrics['test/within_0.01']:6.2f} %",
        f"  within 0.05 sqrt(area)               {100 * metrics['test/within_0.05']:6.2f} %",
        f"  within 0.10 sqrt(area)               {100 * metrics['test/within_0.10']:6.2f} %",
        f"  mean geodesic error / sqrt(area)     {metrics['test/geodesic_error']:8.4f}",
        f"  mean geodesic error / diameter       {metrics['test/geodesic_error_diameter']:8.4f}",
        f"  seconds: preprocessing {metrics['seconds/preprocess']:.1f}, "
        f"training {metrics['seconds/train']:.1f}",
        f"Run folder:  {folder}  ({', '.join(written)}, metrics.json, checkpoints)",
        f"TensorBoard: tensorboard --logdir {folder}",
    ]
    log.info("\n".join(lines))


def draw(path: Path, data, predictions) -> None:
    """The template and up to four test shapes, each vertex in the colour of its counterpart."""
    import numpy as np

    from src.figures import render_row, template_colors

    names = data.shapes.names["test"]
    template = data.shapes.template
    colors = template_colors(template)
    chosen = np.unique(np.linspace(0, len(names) - 1, 4).round().astype(int))
    meshes = [template, *(data.shape(names[i]).mesh for i in chosen)]
    render_row(path, meshes, [colors, *(colors[predictions[i]] for i in chosen)],
               ["template", *(names[i] for i in chosen)])  # fmt: skip


def flat(tree: dict, prefix: str = "") -> dict[str, object]:
    """{"a": {"b": 1}} as {"a.b": 1}."""
    leaves: dict[str, object] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            leaves |= flat(value, f"{prefix}{key}.")
        else:
            leaves[prefix + key] = value
    return leaves


def quiet() -> None:
    """Leave out what Lightning says of things that are as they should be here."""
    for name in ("lightning.pytorch", "lightning.fabric", "lightning_fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in (
        ".*does not have many workers.*",  # all tensors are in memory
        ".*exists and is not empty.*",  # a run that goes on
        ".*`isinstance.treespec, LeafSpec.` is deprecated.*",
        ".*smaller than the logging interval.*",
        ".*GPU available but not used.*",
        ".*ended before the epoch ended and your dataloader is not resumable.*",  # ours goes on
    ):
        warnings.filterwarnings("ignore", message)


if __name__ == "__main__":
    main()
