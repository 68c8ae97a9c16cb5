"""Helpers that run the program, in this process or in others."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

from meshspiral.experiment.compose import CONF
from meshspiral.experiment.compose import compose_train as composed
from meshspiral.experiment.run_folder import CONFIG, LAST
from meshspiral.experiment.runs import claim
from meshspiral.training.callbacks import Speed
from meshspiral.training.run import train

__all__ = ["METRICS", "QUICK", "ROOT", "SMALL", "STARTED", "composed"]

ROOT = Path(CONF).parent
SMALL = {  # overrides that make each network small
    "fcs": ["model.channels=[5,6,7]"],
    "lstm": ["model.channels=[5,6,7]"],
    "conv": ["model.channels=[5,6,7]"],
    "gcnn3": ["model.channels=[5,6,7]"],
    "acnn": [
        "model.lifted=5",
        "model.channels=[5,6,7]",
        "model.dense=[9,8]",
        "neighbourhood.times=[24.0,60.0]",
        "neighbourhood.angles=4",
    ],
    "monet": ["model.channels=[5,6,7]", "model.rays=3"],
    "diffusion": ["model.width=12", "model.blocks=2", "neighbourhood.eigenfunctions=20"],
}
QUICK = ["optim.epochs=1"]
SECONDS = {"seconds/preprocess", "seconds/train", "seconds/wait"}
METRICS = {
    "test/exact_match",
    "test/geodesic_error",
    "test/geodesic_error_diameter",
    "test/within_0.01",
    "test/within_0.05",
    "test/within_0.10",
    "parameters",
    "epochs/to_90_percent",
    *SECONDS,
}
# a process that ends as VTK's does without OpenGL, by a segmentation fault
VTK_CRASHES = [sys.executable, "-c", "import os; os._exit(139)"]
STARTED: list[subprocess.Popen] = []  # in sessions of their own; killed after each test


def run(folder: Path, overrides: list[str]) -> dict[str, float]:
    """Train in a folder, as the command does; returns the metrics."""
    folder.mkdir(exist_ok=True)
    config = composed(overrides)
    if not (folder / CONFIG).exists():
        claim(folder, config)
    return train(config, folder)


def weights(folder: Path, name: str = LAST) -> dict[str, torch.Tensor]:
    return torch.load(folder / name, weights_only=True)["state_dict"]


def same_weights(a: Path, b: Path) -> bool:
    one, two = weights(a), weights(b)
    assert one.keys() == two.keys()
    return all(torch.equal(one[k], two[k]) for k in one)


def stop_at(monkeypatch, step: int) -> Callable[[], None]:
    """Interrupt training in this process after a step; returns what takes that back."""
    original = Speed.on_train_batch_end

    def stop(self, trainer, *args):
        original(self, trainer, *args)
        if trainer.global_step == step:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Speed, "on_train_batch_end", stop)
    return lambda: monkeypatch.setattr(Speed, "on_train_batch_end", original)


def start(command: list[str], **options) -> subprocess.Popen:
    """Start a process in a session of its own, which ends with the test."""
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        **options,
    )
    STARTED.append(process)
    return process


def program_process(overrides: list[str], folder: Path) -> subprocess.Popen:
    """Start `python -m src.train` with a run folder."""
    command = [sys.executable, "-m", "src.train", *overrides, f"hydra.run.dir={folder}"]
    return start(command, cwd=ROOT)


def wait_for(condition: Callable[[], bool], process: subprocess.Popen, seconds: float = 120):
    """Wait until a condition holds while a process runs."""
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.01)


def clone_environment() -> dict[str, str]:
    """Environment variables that let a process import this clone from any folder."""
    paths = [str(ROOT), str(ROOT / "src"), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
