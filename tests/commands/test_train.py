"""The command `train`: the files of a run, its repeatability, resuming, and learning."""

from __future__ import annotations

import json
import os
import platform
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import lightning as L
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from meshspiral.data.shapes import DataError
from meshspiral.data.sources import open_data
from meshspiral.data.tensors import draw
from meshspiral.experiment.run_folder import (
    BEST,
    CONFIG,
    LAST,
    METRICS,
    RunError,
    Stopped,
    read_run_config,
)
from meshspiral.experiment.runs import claim, resumed_config
from meshspiral.experiment.schema import read_stored_config
from meshspiral.training.callbacks import Figures, Speed
from meshspiral.training.checkpoints import AtomicFiles, Checkpoint
from meshspiral.training.module import Correspondence
from meshspiral.training.run import train
from tests import helpers
from tests.helpers import (
    ROOT,
    VTK_CRASHES,
    composed,
    program_process,
    run,
    same_weights,
    wait_for,
    weights,
)


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory, toy_overrides):
    """An uninterrupted run: its folder and its metrics."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, run(folder, toy_overrides)


# -------------------------------------------------------------------------------- the run folder


def test_a_run_folder_holds_metrics_checkpoints_and_logs(whole_run):
    folder, metrics = whole_run
    assert metrics.keys() >= helpers.METRICS
    assert json.loads((folder / METRICS).read_text()) == metrics
    assert all(isinstance(value, int | float) for value in metrics.values())
    for name in (CONFIG, BEST, LAST, "curve.png"):
        assert (folder / name).is_file()
    assert list(folder.glob("events.out.tfevents.*"))
    assert metrics["parameters"] == sum(w.numel() for w in weights(folder).values())
    assert not list(folder.rglob("*.tmp"))


def test_metrics_hold_the_best_validation_and_the_total_training_time(whole_run):
    folder, metrics = whole_run
    saved = {name: torch.load(folder / name, weights_only=True) for name in (BEST, LAST)}
    validation, curve = saved[BEST]["validation"]
    assert validation.items() <= metrics.items()
    assert curve[0] == pytest.approx(validation["val/exact_match"])
    assert metrics["seconds/train"] > saved[LAST]["callbacks"]["Speed"]["seconds"]


def test_metrics_and_plots_are_logged_to_tensorboard(whole_run):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(whole_run[0])).Reload()
    scalars = set(events.Tags()["scalars"])
    assert scalars >= {
        "train/loss_step",
        "train/loss_epoch",
        "val/loss",
        "val/exact_match",
        "val/geodesic_error",
        "val/geodesic_error_diameter",
        "val/within_0.01",
        "val/within_0.05",
        "val/within_0.10",
        "lr-Adam",
        "train/steps_per_second",
        "test/exact_match",
    }
    assert len(events.Scalars("val/loss")) == 4  # every epoch
    assert events.Images("val/curve") and events.Images("val/shape") and events.Images("test/curve")


def test_plots_in_tensorboard_take_at_most_one_per_cent_of_the_time():
    """New plots wait until the earlier ones took less than 1 % of the time since the start."""
    looks, drawn = Figures(), []
    looks._curve = lambda *arguments: (drawn.append(1), time.sleep(0.05))
    trainer = SimpleNamespace(state=SimpleNamespace(fn="fit"), is_global_zero=False)
    looks.on_train_start(trainer, None)
    looks.on_validation_end(trainer, None)
    looks.on_validation_end(trainer, None)
    assert len(drawn) == 1
    looks._began -= 80 * looks._spent  # as if that much time had passed
    looks.on_validation_end(trainer, None)
    assert len(drawn) == 1
    looks._began -= 30 * looks._spent
    looks.on_validation_end(trainer, None)
    assert len(drawn) == 2
    trainer.state.fn = "validate"  # validation outside training
    looks._began -= 600
    looks.on_validation_end(trainer, None)
    assert len(drawn) == 2


def test_metrics_can_be_recomputed_from_the_checkpoint_alone(whole_run):
    """From best.ckpt, without the evaluation code of the program."""
    folder, metrics = whole_run
    saved = torch.load(folder / BEST, weights_only=True)["hyper_parameters"]
    assert saved["config"] == OmegaConf.to_container(OmegaConf.load(folder / CONFIG))
    config = read_stored_config(saved["config"])
    module = Correspondence.load_from_checkpoint(folder / BEST, weights_only=True).eval()
    data = open_data(config)
    data.prepare(["test"])
    right, losses = [], []
    for item in data.datasets["test"]:
        batch = draw(data.neighbourhood, item, config.seed, "spirals", "evaluation")
        with torch.no_grad():
            scores = module.net(item["features"], batch["spirals"])
        right.append(scores.argmax(1) == item["labels"])
        losses.append(torch.nn.functional.cross_entropy(scores, item["labels"]))
    exact = torch.cat(right).double().mean().item()
    assert exact == pytest.approx(metrics["test/exact_match"], abs=1e-6)
    assert torch.stack(losses).mean().item() == pytest.approx(metrics["test/loss"], rel=1e-4)


def test_the_ratio_of_the_two_geodesic_errors_is_the_diameter(whole_run):
    folder, metrics = whole_run
    config = read_run_config(folder)
    data = open_data(config)
    ratio = metrics["test/geodesic_error"] / metrics["test/geodesic_error_diameter"]
    assert ratio == pytest.approx(data.reference.diameter, rel=1e-5)


def test_validation_metrics_cover_one_epoch_and_all_its_meshes(whole_run):
    """A fresh module with the weights of last.ckpt gives the metrics stored in last.ckpt."""
    folder, _ = whole_run
    config = read_run_config(folder)
    data = open_data(config)
    data.prepare(["val"])
    module = Correspondence(config.model_dump(), data.in_features, data.num_classes)
    trainer = L.Trainer(accelerator="cpu", logger=False, enable_progress_bar=False)
    checkpoint = torch.load(folder / LAST, weights_only=True)
    module.load_state_dict(checkpoint["state_dict"])
    trainer.validate(module, datamodule=data)
    saved, _ = checkpoint["validation"]
    assert module.metrics["val"] == pytest.approx(saved)


def test_the_learning_rate_warms_up_and_follows_half_a_cosine(whole_run, toy_overrides):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    config = composed(toy_overrides).model_dump()
    module = Correspondence(config, 160, 162)
    module._trainer = SimpleNamespace(estimated_stepping_batches=24)
    [factor] = module.configure_optimizers()["lr_scheduler"]["scheduler"].lr_lambdas
    warmup = 4  # 0.15 of 24, rounded
    expected = [(step + 1) / warmup for step in range(warmup)]
    expected += [
        0.5 * (1 + np.cos(np.pi * (s - warmup) / (24 - warmup))) for s in range(warmup, 24)
    ]
    np.testing.assert_allclose([factor(step) for step in range(24)], expected)
    events = EventAccumulator(str(whole_run[0])).Reload().Scalars("lr-Adam")
    assert len(events) >= 2
    for event in events:
        rate = config["optim"]["lr"] * expected[event.step]
        assert event.value == pytest.approx(rate, rel=1e-5)


def test_dropout_differs_between_meshes_and_epochs_but_not_between_runs(toy_overrides):
    config = composed(toy_overrides).model_dump()
    module = Correspondence(config, 160, 162)

    def random_number(mesh):
        module.on_train_batch_start({"index": mesh}, 0)
        return torch.rand(1).item()

    assert len({random_number(mesh) for mesh in range(5)}) == 5
    assert random_number(2) == random_number(2)
    before = random_number(2)
    module._trainer = SimpleNamespace(current_epoch=1)
    assert random_number(2) != before


# ---------------------------------------------------------------------------------- repeatability


def test_two_runs_with_one_seed_agree_to_the_bit_and_another_seed_differs(
    whole_run, toy_overrides, tmp_path
):
    folder, metrics = whole_run
    again = run(tmp_path / "again", toy_overrides)
    assert same_weights(folder, tmp_path / "again")
    assert {k: v for k, v in again.items() if "seconds" not in k} == {
        k: v for k, v in metrics.items() if "seconds" not in k
    }
    run(tmp_path / "other", [*toy_overrides, "seed=1"])
    assert not same_weights(folder, tmp_path / "other")


@pytest.mark.parametrize("model", ["fcs", "lstm", "gcnn3"])
def test_runs_of_all_networks_agree_on_two_threads(model, toy_overrides, tmp_path):
    threads = torch.get_num_threads()
    several = ["trainer.threads=2", "model.channels=[100,150,200]", "optim.epochs=2"]
    for name in "ab":
        run(tmp_path / name, [*toy_overrides, f"model={model}", *several])
        assert torch.get_num_threads() == 2
    torch.set_num_threads(threads)
    assert same_weights(tmp_path / "a", tmp_path / "b")


STEPS = 6  # per epoch of the toy data set


@pytest.mark.parametrize(
    "signum, step, readers",
    [(signal.SIGINT, step, 0) for step in (1, 2, STEPS - 1, STEPS, STEPS + 3, 4 * STEPS)]
    + [(signal.SIGTERM, 2, 0), (signal.SIGTERM, STEPS, 0)]
    + [(signal.SIGINT, 2, 1)],  # with meshes that were read ahead
)
def test_a_stopped_run_resumes_to_the_same_weights(
    whole_run, toy_overrides, tmp_path, monkeypatch, signum, step, readers
):
    """Stopped after the first step, within an epoch, at its end, and after the last step."""
    toy_overrides = [*toy_overrides, f"data.readers={readers}"]
    original = Speed.on_train_batch_end

    def stop(self, trainer, *args):
        original(self, trainer, *args)
        if trainer.global_step == step:
            os.kill(os.getpid(), signum)

    monkeypatch.setattr(Speed, "on_train_batch_end", stop)
    with pytest.raises(Stopped) as stopped:
        run(tmp_path, toy_overrides)
    assert stopped.value.signum == signum
    assert (tmp_path / LAST).is_file() and not (tmp_path / METRICS).exists()
    saved = torch.load(tmp_path / LAST, weights_only=True)
    assert saved["global_step"] == (6 if step == STEPS - 1 else step)  # see GracefulStop
    monkeypatch.setattr(Speed, "on_train_batch_end", original)
    metrics = run(tmp_path, toy_overrides)
    assert same_weights(whole_run[0], tmp_path)
    for name in helpers.METRICS - helpers.SECONDS:
        assert metrics[name] == whole_run[1][name]
    assert metrics["seconds/train"] >= saved["callbacks"]["Speed"]["seconds"]


@pytest.mark.parametrize("done", [2, 4, 5, 6, 9])
def test_a_stopped_run_with_several_meshes_a_step_resumes_to_the_same_weights(
    toy_overrides, tmp_path, monkeypatch, done
):
    """Stopped after some meshes; a step of four and a step of two make an epoch."""
    overrides = [*toy_overrides, "trainer.accumulate=4", "optim.epochs=3"]
    run(tmp_path / "whole", overrides)
    original, served = Speed.on_train_batch_end, []

    def stop(self, trainer, *args):
        original(self, trainer, *args)
        served.append(trainer.global_step)
        if len(served) == done:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Speed, "on_train_batch_end", stop)
    with pytest.raises(Stopped):
        run(tmp_path / "part", overrides)
    assert len(served) == {2: 4, 4: 4, 5: 6, 6: 6, 9: 10}[done]  # the end of a step
    monkeypatch.setattr(Speed, "on_train_batch_end", original)
    with pytest.raises(RunError, match=r"of a run with trainer\.accumulate=4, not 1"):
        run(tmp_path / "part", [*toy_overrides, "optim.epochs=3"])
    run(tmp_path / "part", overrides)
    assert torch.load(tmp_path / "part" / LAST, weights_only=True)["global_step"] == 6
    assert same_weights(tmp_path / "whole", tmp_path / "part")


def test_a_killed_run_resumes_to_the_same_weights(toy_overrides, tmp_path):
    """A separate process, killed with SIGKILL; resumed with resume=<run folder>."""
    overrides = [*toy_overrides, "optim.epochs=12"]
    run(tmp_path / "whole", overrides)
    folder = tmp_path / "killed"
    process = program_process(overrides, folder)
    seen = set()

    def third_checkpoint():
        if (folder / LAST).exists():
            seen.add((folder / LAST).stat().st_mtime_ns)
        return len(seen) >= 3

    wait_for(third_checkpoint, process)
    process.kill()
    process.wait()
    epoch = torch.load(folder / LAST, weights_only=True)["epoch"]
    assert 1 <= epoch < 11 and not (folder / METRICS).exists()
    resumed = subprocess.run(
        [sys.executable, "-m", "src.train", f"resume={folder}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert resumed.returncode == 0, resumed.stderr
    assert same_weights(tmp_path / "whole", folder)
    assert f"Run folder:  {folder}" in resumed.stdout
    assert json.loads((folder / METRICS).read_text()).keys() >= helpers.METRICS


def test_a_run_that_diverges_stops_with_a_one_line_error(toy_overrides, tmp_path):
    with pytest.raises(RunError) as error:
        run(tmp_path, [*toy_overrides, "optim.lr=1e30", "optim.warmup=0.5"])
    message = str(error.value)
    for part in (
        "the loss must be finite",
        "in epoch ",
        "step ",
        "learning rate",
        "smaller optim.lr",
    ):
        assert part in message
    assert not (tmp_path / METRICS).exists()
    if (tmp_path / LAST).exists():
        assert all(weight.isfinite().all() for weight in weights(tmp_path).values())


def test_spirals_longer_than_a_mesh_give_a_one_line_error(toy_overrides, tmp_path):
    message = r"\w+_\d: spirals must have at most the 162 vertices of the mesh, got 163"
    with pytest.raises(DataError, match=message):
        run(tmp_path, [*toy_overrides, "seq_len=163"])


@pytest.mark.parametrize("signum, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_program_says_how_to_resume(toy_overrides, tmp_path, signum, code):
    folder = tmp_path / "run"
    process = program_process([*toy_overrides, "optim.epochs=500"], folder)
    wait_for((folder / LAST).exists, process)
    process.send_signal(signum)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == code
    assert f"To resume: python -m src.train resume={folder}" in output
    assert "Traceback" not in output
    torch.load(folder / LAST, weights_only=True)


def test_a_signal_to_all_processes_of_a_run_with_readers_stops_in_order(toy_overrides, tmp_path):
    """As Ctrl-C in a terminal sends it."""
    folder = tmp_path / "run"
    process = program_process([*toy_overrides, "optim.epochs=500", "data.readers=1"], folder)
    wait_for((folder / LAST).exists, process)
    os.killpg(process.pid, signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 130, output
    assert f"To resume: python -m src.train resume={folder}" in output
    assert "Traceback" not in output and "DataLoader" not in output


def test_a_failed_write_leaves_the_previous_checkpoint(tmp_path, monkeypatch):
    io = AtomicFiles()
    io.save_checkpoint({"a": torch.ones(3)}, tmp_path / "last.ckpt")

    def disk_full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", disk_full)
    with pytest.raises(OSError, match=r"cannot write the checkpoint .*last\.ckpt \(No space left"):
        io.save_checkpoint({"a": torch.zeros(3)}, tmp_path / "last.ckpt")
    assert torch.load(tmp_path / "last.ckpt", weights_only=True)["a"].sum() == 3
    assert [p.name for p in tmp_path.iterdir()] == ["last.ckpt"]


def test_a_checkpoint_that_is_damaged_or_of_another_run_is_rejected(
    whole_run, toy_overrides, tmp_path
):
    folder, _ = whole_run
    config = composed(toy_overrides)
    for damage, message in [(lambda b: b[:-500], "is damaged"), (lambda b: b"no", "is damaged")]:
        (tmp_path / "checkpoints").mkdir(exist_ok=True)
        (tmp_path / LAST).write_bytes(damage((folder / LAST).read_bytes()))
        with pytest.raises(RunError, match=message):
            train(config, tmp_path)
    (tmp_path / LAST).write_bytes((folder / LAST).read_bytes())
    (tmp_path / BEST).write_bytes(b"no")
    with pytest.raises(RunError, match=r"best\.ckpt is damaged .* delete the run's checkpoints"):
        train(config, tmp_path)
    (tmp_path / BEST).unlink()
    with pytest.raises(
        RunError, match=r"is of another run: neighbourhood\.seq_len must be 9, got 8"
    ):
        train(composed([*toy_overrides, "seq_len=9"]), tmp_path)


def test_a_moved_run_folder_keeps_its_best_checkpoint(whole_run, tmp_path):
    callbacks = torch.load(whole_run[0] / LAST, weights_only=True)["callbacks"]
    [state] = [s for key, s in callbacks.items() if "val/geodesic_error" in key]
    assert Path(state["best_model_path"]) == whole_run[0] / BEST
    moved = Checkpoint(tmp_path / "checkpoints", "best", monitor="val/geodesic_error")
    moved.load_state_dict(state)
    assert moved.best_model_score == state["best_model_score"] < 1
    path = str(tmp_path / BEST)
    assert moved.best_model_path == moved.kth_best_model_path == path
    assert moved.best_k_models == {path: state["best_model_score"]}


def test_resume_uses_the_config_of_the_run_and_allows_only_harmless_changes(
    tmp_path, toy_overrides
):
    claim(tmp_path, composed(toy_overrides))
    resume = [f"resume={tmp_path}"]
    assert resumed_config(composed(resume), resume).model.channels == [12, 14, 16]
    same = [*toy_overrides, *resume]
    assert resumed_config(composed(same), same).seq_len == 8
    faster = [*resume, "trainer.threads=2"]
    assert resumed_config(composed(faster), faster).trainer.threads == 2
    group = ["data=folder", *resume]
    named = [*(o for o in toy_overrides if o.startswith("data.")), "data.workers=3"]
    assert resumed_config(composed([*group, *named]), [*group, *named]).data.workers == 3
    read = [*resume, "data.readers=2"]
    assert resumed_config(composed(read), read).data.readers == 2
    for other in ("seq_len=9", "model=lstm", "seed=4", "optim.lr=0.1", "+metric=true"):
        overrides = [*resume, other]
        with pytest.raises(RunError, match="contradicts the run in"):
            resumed_config(composed(overrides), overrides)


def test_a_run_older_than_a_setting_resumes(tmp_path, toy_overrides):
    config = composed(toy_overrides)
    claim(tmp_path, config)
    old = OmegaConf.load(tmp_path / CONFIG)
    del old.data.shuffle_vertices, old.model.metric_layers, old.picture
    OmegaConf.save(old, tmp_path / CONFIG)
    claim(tmp_path, config)
    resume = [f"resume={tmp_path}"]
    assert resumed_config(composed(resume), resume).model.metric_layers == "all"


def test_a_run_resumes_whose_disks_had_a_setting_of_another_name(tmp_path, toy_overrides):
    config = composed([*toy_overrides, "model=monet", "neighbourhood.max_vertices=20"])
    claim(tmp_path, config)
    old = OmegaConf.load(tmp_path / CONFIG)
    old.neighbourhood.most = old.neighbourhood.pop("max_vertices")
    OmegaConf.save(old, tmp_path / CONFIG)
    resume = [f"resume={tmp_path}"]
    assert resumed_config(composed(resume), resume) == config


@pytest.mark.parametrize(
    "overrides, old_model",
    [
        (["model=lstm", "neighbourhood.rings=2"], {"rings": 2}),
        (["model=lstm"], {"rings": None}),
        ([], {}),
        (
            ["model=gcnn3", "neighbourhood.radius=0.2", "neighbourhood.rays=8"],
            {"patch": {"radius": 0.2, "rings": 5, "rays": 8}},
        ),
    ],
)
def test_a_run_of_version_0_1_resumes(tmp_path, toy_overrides, overrides, old_model):
    """Version 0.1 had no group `neighbourhood`; its settings belonged to the model."""
    config = composed([*toy_overrides, *overrides])
    claim(tmp_path, config)
    old = OmegaConf.load(tmp_path / CONFIG)
    del old.neighbourhood, old.plugins
    old.model.update(old_model)
    OmegaConf.save(old, tmp_path / CONFIG)
    claim(tmp_path, config)
    resume = [f"resume={tmp_path}"]
    assert resumed_config(composed(resume), resume) == config


def test_resuming_a_folder_that_is_not_a_run_is_rejected(tmp_path):
    for path, message in [(tmp_path / "none", "is not a folder"), (tmp_path, "is not a run")]:
        overrides = [f"resume={path}"]
        with pytest.raises(RunError, match=message):
            resumed_config(composed(overrides), overrides)
    (tmp_path / CONFIG).write_text("a: [1, ")
    with pytest.raises(RunError, match="cannot be read"):
        resumed_config(composed([f"resume={tmp_path}"]), [f"resume={tmp_path}"])


# -------------------------------------------------------------------------------------- learning


@pytest.mark.parametrize(
    "overrides",
    [
        ["model=lstm"],
        ["model=lstm", "metric=true"],
        ["model=lstm", "neighbourhood.rings=1", "+metric=true"],
        ["model=gcnn3"],
        [
            "model=gcnn3",
            "neighbourhood.weights=gaussian",
            "neighbourhood.rings=3",
            "neighbourhood.rays=8",
        ],
        ["model=gcnn3", "trainer.precision=bf16"],
        ["model=gcnn3", "trainer.precision=64"],
        ["metric=true"],
        ["metric=true", "model.metric_layers=first"],
        ["trainer.precision=bf16"],
        ["trainer.precision=auto"],
        ["trainer.precision=64"],
        ["optim.schedule=constant"],
        ["trainer.val_every=2", "optim.epochs=3"],
        ["neighbourhood.start=frame", "neighbourhood.dilation=2"],
        ["neighbourhood=sampled", "neighbourhood.pooled=2", "data.features=[shot,raw]"],
        ["model=conv", "neighbourhood=sampled", "neighbourhood.blend=true", "metric=true"],
    ],
    ids=" ".join,
)
def test_every_variant_trains(toy_overrides, tmp_path, overrides):
    metrics = run(tmp_path, [*toy_overrides, "optim.epochs=1", *overrides])
    assert metrics.keys() >= helpers.METRICS and all(np.isfinite(v) for v in metrics.values())


LEARN = ["optim.epochs=60", "optim.lr=0.01", "model.dropout=0.1", "trainer.val_every=20"]


def test_a_length_that_does_not_apply_is_said(cli, toy_overrides):
    words = [word for word in toy_overrides if not word.startswith("seq_len")]
    code, out, err = cli(*words, "optim.epochs=1", "neighbourhood=sampled", "seq_len=9")
    assert code == 0 and "seq_len=9: ignored, does not apply to sampled" in out, err


def test_a_network_learns_independently_of_the_numbering(toy_overrides, tmp_path):
    """The metrics with every mesh randomly renumbered agree within noise, least without dropout."""
    words = [*toy_overrides, *LEARN, "model.dropout=0"]
    original = run(tmp_path / "original", words)
    shuffled = run(tmp_path / "shuffled", [*words, "data.shuffle_vertices=true"])
    assert original["test/exact_match"] > 0.6  # chance: 0.006
    assert shuffled["test/exact_match"] == pytest.approx(original["test/exact_match"], abs=0.12)
    assert shuffled["test/geodesic_error"] == pytest.approx(
        original["test/geodesic_error"], abs=0.06
    )


def test_gcnn3_learns(toy_overrides, tmp_path):
    gcnn3 = ["model=gcnn3", "neighbourhood.radius=0.2", "optim.lr=0.004"]
    metrics = run(tmp_path, [*toy_overrides, *LEARN, *gcnn3])
    assert metrics["test/exact_match"] > 0.5  # chance: 0.006


def test_renders_need_no_display(toy_overrides, tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    run(tmp_path, [*toy_overrides, "optim.epochs=1", "picture=true"])
    import matplotlib.image

    for name in ("correspondence.png", "errors.png"):
        image = matplotlib.image.imread(tmp_path / name)[..., :3]
        assert (image < 0.95).any(axis=2).mean() > 0.05  # the background is white
        assert image.std(axis=(0, 1)).min() > 0.02


def test_without_opengl_renders_are_skipped_with_a_warning(
    toy_overrides, tmp_path, monkeypatch, caplog
):
    monkeypatch.setattr("meshspiral.viz.render.COMMAND", VTK_CRASHES)
    run(tmp_path, [*toy_overrides, "optim.epochs=1", "picture=true"])
    assert "skipping renders: VTK failed; it needs an OpenGL library" in caplog.text
    assert (tmp_path / METRICS).is_file()


def test_freed_memory_stays_with_the_process():
    """Only glibc has the setting for it."""
    if platform.libc_ver()[0] != "glibc":
        pytest.skip("needs glibc")
    script = (
        "import resource, torch; from meshspiral.training.device import *; keep_freed_memory()\n"
        "for i in range(20):\n"
        "    torch.ones(2**24)\n"
        "    if i == 1: first = resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - first)"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert int(done.stdout) < 9 * 2**14  # a tensor has 2**14 pages; 18 are counted
