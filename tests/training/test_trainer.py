"""What is set and checked before training begins, and when the loss is read."""

from __future__ import annotations

import os

import lightning as L
import pytest

from meshspiral.commands.train import is_one_process, trainer_words
from meshspiral.data.shapes import DataError
from meshspiral.experiment.run_folder import LAST
from meshspiral.training.module import CHECK_EVERY, is_checked
from meshspiral.training.trainer import build_trainer
from tests.helpers import composed, run

DDP = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2"]


def test_a_split_smaller_than_the_processes_is_refused_before_training(
    toy_overrides, tmp_path, monkeypatch
):
    monkeypatch.setattr(L.Trainer, "world_size", property(lambda self: 9))
    with pytest.raises(DataError, match="the split val must have a mesh for each of 9 processes"):
        run(tmp_path, toy_overrides)
    assert not (tmp_path / LAST).exists()


def test_every_process_has_the_threads_asked_for(toy_overrides, tmp_path, monkeypatch):
    """Lightning sets another number in each process unless this variable is set."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    build_trainer(composed([*toy_overrides, *DDP, "trainer.threads=3"]), tmp_path)
    assert os.environ["OMP_NUM_THREADS"] == "3"
    build_trainer(composed([*toy_overrides, "trainer.threads=1"]), tmp_path)


def test_jobs_in_several_processes_get_all_settings_of_their_trainer():
    """Also those of an experiment file, which their own command line does not name."""
    words = ["experiment=tessellation", "variant=sampled", *DDP]
    config = composed(words)
    assert config.trainer.val_every == 4
    again = composed(["optim.epochs=12", *trainer_words(config.trainer)])
    assert again.trainer == config.trainer


@pytest.mark.parametrize(
    "words, one",
    [
        ([], True),
        (["trainer.devices='1'"], True),
        (["trainer=gpu"], True),
        (["trainer.devices=2"], False),
        (["trainer=gpu", "trainer.devices=auto"], False),
        (["trainer=ddp"], False),
    ],
)
def test_several_devices_are_several_processes(words, one):
    assert is_one_process(composed(words).trainer) == one


def test_the_loss_is_read_before_each_checkpoint():
    assert all(is_checked("cpu", batch, 25) for batch in range(25))
    assert [b for b in range(25) if is_checked("cuda", b, 25)] == [0, CHECK_EVERY, 20, 24]
