"""Lightning's trainer as a config asks for it."""

from __future__ import annotations

import logging
import os
import warnings
from pathlib import Path

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback, LearningRateMonitor
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from meshspiral.experiment.schema import ConfigError, TrainConfig
from meshspiral.training.callbacks import Bar, Figures, GracefulStop, ValidateLast
from meshspiral.training.checkpoints import AtomicFiles, Checkpoint
from meshspiral.training.device import choose_precision, set_up_process


def build_trainer(config: TrainConfig, folder: Path, *callbacks: Callback) -> L.Trainer:
    """A trainer that logs to a run folder and writes its checkpoints there.

    best.ckpt has the weights with the least mean geodesic error on validation, last.ckpt all that
    the run needs to be resumed.

    Raises:
        ConfigError: This machine lacks the device.
    """
    quiet()
    asked = config.trainer
    # auto never takes Apple's GPUs, which have no float64
    auto = "cuda" if torch.cuda.is_available() else "cpu"
    accelerator = {"gpu": "cuda", "auto": auto}.get(asked.accelerator, asked.accelerator)
    set_up_process(asked.threads or torch.get_num_threads(), keep_memory=accelerator == "cpu")
    if asked.threads and asked.strategy == "ddp":
        os.environ["OMP_NUM_THREADS"] = str(asked.threads)  # else Lightning sets another number
    # `deterministic` below would also fill every new tensor with NaN, which costs time
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
            accumulate_grad_batches=asked.accumulate,
            deterministic=accelerator == "cpu",
            logger=TensorBoardLogger(folder, name="", version="", default_hp_metric=False),
            log_every_n_steps=10,
            num_sanity_val_steps=0,
            use_distributed_sampler=False,  # ours repeat no mesh in a test
            enable_model_summary=False,
            plugins=[AtomicFiles()],
            callbacks=[
                Bar(),
                Figures(),
                GracefulStop(folder),
                ValidateLast(),
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
            f"{asked.strategy}, precision {asked.precision} is not available here ({reason})"
        ) from error


def quiet() -> None:
    """Silence Lightning's messages about things that are intended here."""
    for name in ("lightning.pytorch", "lightning.fabric", "lightning_fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in (
        ".*does not have many workers.*",  # the data module chooses how many read
        ".*exists and is not empty.*",  # a resumed run
        ".*`isinstance.treespec, LeafSpec.` is deprecated.*",
        ".*smaller than the logging interval.*",
        ".*GPU available but not used.*",
        ".*ended before the epoch ended and your dataloader is not resumable.*",  # ours is
    ):
        warnings.filterwarnings("ignore", message)
