"""Shared fixtures: a toy data set that a network learns in seconds, and the command line."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # waiting threads leave the cores to others
os.environ.setdefault("OMP_NUM_THREADS", "1")  # read by torch; the tests run in parallel

import numpy as np
import pytest
import trimesh
from hydra.core.global_hydra import GlobalHydra

from meshspiral.commands.train import main
from meshspiral.geometry.mesh import Mesh
from tests.helpers import STARTED
from tests.meshes import bumpy_sphere

TOY_SPLIT = {"train": 6, "val": 3, "test": 3}


def toy_shapes() -> dict[str, Mesh]:
    """A template of 162 vertices, and twelve smooth deformations of it, by file name."""
    template = bumpy_sphere(7, subdivisions=2, bump=0.6)
    shapes = {"template.ply": template}
    for split, count in TOY_SPLIT.items():
        for i in range(count):
            rng = np.random.default_rng([len(split), i])
            x = template.vertices
            bend = 0.05 * np.sin(x @ rng.normal(size=(3, 3)) + rng.uniform(0, 6, 3))
            shapes[f"{split}/{i}.ply"] = Mesh(x + bend, template.faces)
    return shapes


@pytest.fixture(scope="session")
def toy(tmp_path_factory) -> Path:
    """The folder of the toy data set, in the layout of `data=folder`."""
    root = tmp_path_factory.mktemp("toy")
    for name, mesh in toy_shapes().items():
        path = root / name
        path.parent.mkdir(exist_ok=True)
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
    return root


# the files that take longest, which no process should begin last
FIRST = ("test_sweeps.py", "test_train.py", "test_match.py", "test_cli.py", "test_docs.py")


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: item.path.name not in FIRST)


@pytest.fixture
def cli(monkeypatch, tmp_path, capfd):
    """Call a command in this process, in tmp_path; returns (exit code, stdout, stderr)."""

    def call(*arguments: str, program=main):
        GlobalHydra.instance().clear()
        handlers = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}
        root = logging.getLogger()
        before = root.handlers[:], root.level
        monkeypatch.setattr(sys, "argv", ["src.train", *arguments])
        code = 0
        try:
            program()
        except SystemExit as stop:
            code = stop.code or 0
        finally:
            for signum, handler in handlers.items():
                signal.signal(signum, handler)
            root.handlers, root.level = before
            GlobalHydra.instance().clear()
        return code, *capfd.readouterr()

    monkeypatch.chdir(tmp_path)
    return call


@pytest.fixture(autouse=True)
def no_process_survives():
    """Kill the processes that a test started."""
    yield
    while STARTED:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(STARTED.pop().pid, signal.SIGKILL)


@pytest.fixture(scope="session")
def toy_overrides(toy, tmp_path_factory) -> list[str]:
    """The command line that trains a small network on the toy data set."""
    cache = tmp_path_factory.mktemp("cache")
    return [
        "data=folder",
        f"data.root={toy}",
        "data.template=template.ply",
        "data.labels=identity",
        "data.train=[train/*.ply]",
        "data.val=[val/*.ply]",
        "data.test=[test/*.ply]",
        f"data.cache_dir={cache}",
        "data.shot.radius=0.3",
        "data.shot.bins=4",
        "data.workers=1",
        "model.channels=[12,14,16]",
        "seq_len=8",
        "trainer.threads=1",
        "picture=false",
        "optim.epochs=4",
    ]
