"""Training a run longer: its learning rate, its config, and what a finished run says."""

from __future__ import annotations

import json
import logging
import shutil

import pytest

from meshspiral.data.shapes import DataError
from meshspiral.experiment.run_folder import (
    LAST,
    METRICS,
    RunError,
    Stopped,
    read_run_config,
    write_config,
)
from meshspiral.experiment.runs import resumed_config
from meshspiral.training.callbacks import Speed
from meshspiral.training.module import rate_factor
from meshspiral.training.run import train
from tests.helpers import composed, run, same_weights, stop_at

STEPS = 6  # per epoch of the toy data set


@pytest.fixture(scope="module")
def two_epochs(tmp_path_factory, toy_overrides):
    """A finished run of two epochs."""
    folder = tmp_path_factory.mktemp("two")
    run(folder, [*toy_overrides, "optim.epochs=2"])
    return folder


@pytest.fixture
def finished(two_epochs, tmp_path):
    """A copy of it."""
    return shutil.copytree(two_epochs, tmp_path / "finished")


def resume(folder, *words):
    """As the command does with resume=<folder>."""
    words = [f"resume={folder}", *words]
    return train(resumed_config(composed(words), words), folder)


def rates(folder) -> dict[int, float]:
    """The logged learning rates, by step."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder)).Reload().Scalars("lr-Adam")
    return {event.step: event.value for event in events}


def test_with_a_constant_rate_a_longer_run_equals_an_uninterrupted_one(toy_overrides, tmp_path):
    constant = [*toy_overrides, "optim.schedule=constant"]
    run(tmp_path / "whole", [*constant, "optim.epochs=4"])
    run(tmp_path / "longer", [*constant, "optim.epochs=2"])
    resume(tmp_path / "longer", "optim.epochs=4")
    assert same_weights(tmp_path / "whole", tmp_path / "longer")


def test_the_rate_follows_the_schedule_of_the_new_length(finished, caplog, monkeypatch):
    """From the first step on, which a checkpoint would let run at the rate of the old schedule."""
    caplog.set_level(logging.INFO)
    seen = {}

    def note(self, trainer, module, *args):
        seen[trainer.global_step] = trainer.optimizers[0].param_groups[0]["lr"]

    monkeypatch.setattr(Speed, "on_train_batch_start", note)
    monkeypatch.setattr(Speed, "on_train_batch_end", lambda *_: None)
    monkeypatch.setattr(Speed, "on_train_epoch_end", lambda *_: None)
    resume(finished, "optim.epochs=5")
    optim = read_run_config(finished).optim
    expected = {
        step: optim.lr * rate_factor(optim, step, 5 * STEPS) for step in range(12, 5 * STEPS)
    }
    assert seen == pytest.approx(expected)
    rate = expected[12]
    assert rate > 10 * optim.lr * rate_factor(optim, 11, 2 * STEPS)
    line = f"resuming after 2 of 5 epochs, until now 2; the learning rate is now {rate:.3g} and "
    assert line + "follows the cosine of 5 epochs" in caplog.text


def test_the_config_says_the_new_number_and_the_run_is_unfinished(
    finished, two_epochs, monkeypatch, caplog
):
    """A plain resume then goes on to the new number, to the weights of one that was not stopped."""
    whole = shutil.copytree(two_epochs, finished.parent / "whole")
    metrics = resume(whole, "optim.epochs=4")
    assert json.loads((whole / METRICS).read_text()) == metrics
    again = stop_at(monkeypatch, 15)
    with pytest.raises(Stopped):
        resume(finished, "optim.epochs=4")
    again()
    assert read_run_config(finished).optim.epochs == 4
    assert not (finished / METRICS).exists()
    earlier = (finished / "metrics_2_epochs.json").read_text()
    assert earlier == (two_epochs / METRICS).read_text()
    caplog.set_level(logging.INFO)
    resume(finished)
    assert "resuming after 2.5 of 4 epochs\n" in caplog.text + "\n"
    assert same_weights(whole, finished) and not same_weights(finished, two_epochs)
    assert (finished / METRICS).is_file()
    assert read_run_config(finished) == read_run_config(whole)


def test_other_training_meshes_are_refused_before_anything_is_changed(finished, two_epochs, toy):
    config = read_run_config(finished)
    fewer = config.data.model_copy(update={"train": ["train/[0-2].ply"]})
    optim = config.optim.model_copy(update={"epochs": 3})
    with pytest.raises(DataError, match="the 3 training meshes are not those of the run"):
        train(config.model_copy(update={"data": fewer, "optim": optim}), finished)
    assert same_weights(finished, two_epochs) and (finished / METRICS).exists()
    assert read_run_config(finished) == config


@pytest.mark.parametrize("word", ["variant=lstm", "data/remesh=mixed", "data/damage=scans"])
def test_a_file_of_settings_that_contradicts_the_run_is_refused(two_epochs, word):
    words = [f"resume={two_epochs}", word]
    with pytest.raises(RunError, match=f"^{word} contradicts the run"):
        resumed_config(composed(words), words)


def test_another_trainer_changes_the_device_alone(toy_overrides, tmp_path):
    """The command line's default number of epochs is another one, and does not count."""
    stored = composed([*toy_overrides, "optim.epochs=66", "trainer.val_every=11"])
    write_config(tmp_path, stored)
    words = [f"resume={tmp_path}", "trainer=ddp", "trainer.devices=2"]
    trainer = resumed_config(composed(words), words).trainer
    device = {"accelerator": "auto", "devices": 2, "strategy": "ddp"}
    assert trainer == stored.trainer.model_copy(update=device)
    words = [f"resume={tmp_path}", "trainer.val_every=33"]
    assert resumed_config(composed(words), words).trainer.val_every == 33


@pytest.mark.parametrize("words", [[], ["optim.epochs=2"]])
def test_a_finished_run_says_that_it_is_only_tested_again(finished, two_epochs, caplog, words):
    caplog.set_level(logging.INFO)
    resume(finished, *words)
    assert "the run is finished: its 2 epochs are trained, so it is only tested again" in (
        caplog.text
    )
    assert same_weights(finished, two_epochs)
    caplog.clear()
    (finished / METRICS).unlink()
    resume(finished, *words)
    assert "all 2 epochs are trained; only the test is left" in caplog.text


def test_fewer_epochs_than_begun_are_refused(finished, toy_overrides, tmp_path, monkeypatch):
    """Nothing of the run changes. Fewer than planned, but not than begun, shorten the run."""
    before = {path: path.stat().st_mtime_ns for path in finished.rglob("*.*")}
    message = "must be at least 2, the number of epochs that the run in .* has begun, got 1"
    with pytest.raises(RunError, match=message):
        resume(finished, "optim.epochs=1")
    same = {p: t for p, t in before.items() if p.name in ("config.yaml", METRICS, "last.ckpt")}
    assert len(same) == 3 and all(path.stat().st_mtime_ns == time for path, time in same.items())

    again = stop_at(monkeypatch, STEPS + 2)
    with pytest.raises(Stopped):
        run(tmp_path / "run", toy_overrides)
    again()
    with pytest.raises(RunError, match="must be at least 2"):
        resume(tmp_path / "run", "optim.epochs=1")
    assert read_run_config(tmp_path / "run").optim.epochs == 4
    resume(tmp_path / "run", "optim.epochs=3")
    assert max(rates(tmp_path / "run")) < 3 * STEPS
    assert read_run_config(tmp_path / "run").optim.epochs == 3


def test_other_settings_of_a_run_still_may_not_change(finished):
    for word in ("optim.lr=0.1", "optim.warmup=0.5", "optim.schedule=constant", "seed=3"):
        with pytest.raises(RunError, match=r"contradicts .* Free to change: optim\.epochs, init"):
            resume(finished, "optim.epochs=4", word)


def test_the_command_trains_longer_and_another_folder_of_a_sweep_is_not_taken_for_it(
    finished, cli, toy_overrides
):
    code, out, err = cli(*toy_overrides, "optim.epochs=3", f"hydra.run.dir={finished}")
    assert code == 1 and "whose optim.epochs differ" in out + err
    code, out, err = cli("-m", f"resume={finished}", "optim.epochs=3", "hydra.sweep.dir=sweep")
    assert code == 0 and "already finished" not in out, out + err
    assert read_run_config(finished).optim.epochs == 3 and (finished / METRICS).is_file()
    code, out, err = cli(f"resume={finished}", "optim.epochs=2")
    assert code == 1 and "optim.epochs must be at least 3" in out + err
    assert "Traceback" not in out + err and (finished / LAST).is_file()
