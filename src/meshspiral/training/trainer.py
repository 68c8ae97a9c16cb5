"""Lightning's trainer as a config asks for it."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback, LearningRateMonitor
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig

from meshspiral.experiment.schema import ConfigError
from meshspiral.training.callbacks import Bar, Checkpoint, Looks, OrderlyStop, WholeFiles
from meshspiral.training.memory import keep_freed_memory


def build_trainer(config: DictConfig, folder: Path, *callbacks: Callback) -> L.Trainer:
    """A trainer that logs to, and keeps its checkpoints in, a run folder.

    best.ckpt holds the weights with the least mean geodesic error on validation, last.ckpt all that
    the run needs to go on.
    Errors: ConfigError for a device that this machine lacks.
    """
    quiet()
    torch.set_num_threads(config.trainer.threads or torch.get_num_threads())
    torch.set_flush_denormal(True)  # tiny probabilities would slow the softmax down tenfold
    asked = config.trainer
    # never Apple's GPUs, which have no float64
    auto = "cuda" if torch.cuda.is_available() else "cpu"
    accelerator = {"gpu": "cuda", "auto": auto}.get(asked.accelerator, asked.accelerator)
    if accelerator == "cpu":
        keep_freed_memory()
    # `deterministic` below would also fill every new tensor with NaN; nothing here reads one unset
    torch.utils.deterministic.fill_uninitialized_memory = False
    keep = {"dirpath": folder / "checkpoints", "enable_version_counter": False}
    try:
        return L.Trainer(
            accelerator=accelerator,
            devices=asked.devices,
            strategy=asked.strategy,
            precision=choose_precision(asked.precision, accelerator),
            max_epochs=config.optim.epochs,
            check_val_every_n_epoch=asked.val_every,
            deterministic=accelerator == "cpu",
            logger=TensorBoardLogger(folder, name="", version="", default_hp_metric=False),
            log_every_n_steps=10,
            num_sanity_val_steps=0,
            use_distributed_sampler=False,  # ours divide the meshes, and repeat none in a test
            enable_model_summary=False,
            plugins=[WholeFiles()],
            callbacks=[
                Bar(),
                Looks(),
                OrderlyStop(folder),
                LearningRateMonitor("step"),
                Checkpoint(
                    filename="best", monitor="val/geodesic_error", save_weights_only=True, **keep
                ),
                Checkpoint(filename="last", save_on_train_epoch_end=True, **keep),
                *callbacks,
            ],
        )
    except (MisconfigurationException, ValueError, TypeError) as error:
        reason = str(error).strip().splitlines()[0]
        raise ConfigError(
            f"trainer: accelerator {asked.accelerator}, devices {asked.devices}, strategy "
            f"{asked.strategy}, precision {asked.precision} can't be had here ({reason})"
        ) from error


def device_of(accelerator: str) -> str:
    """What torch calls it. Errors: ConfigError if it is not there."""
    if accelerator not in ("cpu", "gpu"):
        raise ConfigError(f"accelerator must be one of cpu, gpu; got {accelerator}")
    if accelerator == "gpu" and not torch.cuda.is_available():
        raise ConfigError("accelerator=gpu: torch finds no GPU here")
    return "cuda" if accelerator == "gpu" else "cpu"


def choose_precision(wanted: str, accelerator: str) -> str:
    """Lightning's name for a precision; auto is bf16 where the hardware multiplies it, else 32."""
    if wanted == "auto":
        if accelerator == "cpu":
            native = [
                getattr(torch.cpu, f"_is_{name}_supported", bool)
                for name in ("avx512_bf16", "amx_tile")
            ]
            wanted = "bf16" if any(check() for check in native) else "32"
        else:
            wanted = (
                "bf16" if torch.cuda.is_available() and torch.cuda.is_bf16_supported() else "32"
            )
    return {"32": "32-true", "64": "64-true", "bf16": "bf16-mixed"}[wanted]


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
