"""The progress bar of training, validations, and the speed."""

from __future__ import annotations

import os
import re
from types import SimpleNamespace

import pytest
import torch

from meshspiral.training.callbacks import Bar, Convergence, Speed
from tests.helpers import run


def test_the_last_epoch_is_validated_too(toy_overrides, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(
        Bar, "on_validation_start", lambda self, trainer, _: seen.append(trainer.current_epoch)
    )
    for name in ("on_validation_batch_end", "on_validation_end"):
        monkeypatch.setattr(Bar, name, lambda *_: None)
    run(tmp_path, [*toy_overrides, "optim.epochs=4", "trainer.val_every=3"])
    assert seen == [2, 3]


def test_the_speed_counts_steps_not_meshes(monkeypatch):
    trainer = SimpleNamespace(accumulate_grad_batches=4)
    logged = {}
    speed = Speed()
    speed.on_train_start(trainer, None)
    for batch in range(8):
        speed.on_train_batch_start(trainer, None, None, batch)
        speed.on_train_batch_end(trainer, None, None, None, batch)
    speed._busy = 1.0
    module = SimpleNamespace(log=lambda key, value, **_: logged.update({key: value}))
    speed.on_train_epoch_end(trainer, module)
    assert logged == {"train/steps_per_second": 2.0}


def test_the_epochs_to_nine_tenths_of_the_best_validation():
    callback, later = Convergence(), Convergence()
    for epoch, exact in ((1, 0.1), (3, 0.46), (5, 0.44), (7, 0.5)):
        module = SimpleNamespace(metrics={"val": {"val/exact_match": exact}})
        callback.on_validation_end(SimpleNamespace(current_epoch=epoch), module)
        later.load_state_dict(callback.state_dict())  # resumed
        callback, later = later, Convergence()
    assert callback.epochs_to(0.9) == 4 and callback.epochs_to(1.0) == 8


@pytest.mark.parametrize("columns, bar", [(80, 6), (120, 40)])
def test_the_bar_and_its_metrics_fit(capfd, monkeypatch, columns, bar):
    """A run of hours, late: the longest texts."""
    size = os.terminal_size((columns, 24))
    monkeypatch.setattr("os.get_terminal_size", lambda *_: size)
    monkeypatch.setattr("meshspiral.data.progress.in_place", lambda stream: True)
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
