"""The progress bar of training."""

from __future__ import annotations

import os
import re
from types import SimpleNamespace

import pytest
import torch

from meshspiral.training.callbacks import Bar


@pytest.mark.parametrize("columns, bar", [(80, 6), (120, 40)])
def test_the_bar_and_its_metrics_fit(capfd, monkeypatch, columns, bar):
    """A run of hours, late: the longest texts."""
    size = os.terminal_size((columns, 24))
    monkeypatch.setattr("os.get_terminal_size", lambda *_: size)
    trainer = SimpleNamespace(
        max_epochs=100,
        current_epoch=98,
        num_training_batches=70,
        num_val_batches=[10],
        accumulate_grad_batches=1,
        fit_loop=SimpleNamespace(epoch_loop=SimpleNamespace(total_batch_idx=-1)),
        is_global_zero=True,
        callback_metrics={
            "val/exact_match": torch.tensor(0.8749),
            "val/geodesic_error": torch.tensor(0.01234),
        },
    )
    callback = Bar()
    callback._trainer = trainer
    callback.on_train_start(trainer, None)
    callback.on_validation_start(trainer, None)
    callback.on_validation_end(trainer, None)
    trainer.current_epoch = 99
    callback.on_train_epoch_start(trainer, None)
    callback._bar.start_t -= 3600
    callback._bar.last_print_t -= 3600  # shown at the next step
    callback._bar.n = 6899
    callback.on_train_batch_end(trainer, None, None, None, 0)
    callback.on_train_end(trainer, None)
    monkeypatch.undo()
    last = capfd.readouterr().err.split("\r")[-1].rstrip("\n")
    assert len(last) <= columns
    assert last.startswith("Epoch 100/100  99%|") and "val 87.5 %, error 0.0123" in last
    assert "step" in last and re.search(r"1:00:0\d<\d", last)
    assert len(last.split("|")[1]) >= bar, last
