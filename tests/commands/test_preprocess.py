"""The command `preprocess`: it fills the cache, alone or on a cluster."""

from __future__ import annotations

import os
import re
import signal
import threading
import time
from collections import Counter
from functools import partial
from pathlib import Path

import pytest
from safetensors.numpy import load

from meshspiral.commands import cache, preprocess, train
from meshspiral.data.datasets.folder import Folder
from meshspiral.data.pool import on_cluster, run_all
from meshspiral.data.shapes import DataError
from meshspiral.geometry.geodesics import GeodesicSolver


@pytest.fixture
def arguments(toy_overrides, tmp_path):
    words = ("data", "seq_len")
    data = [o for o in toy_overrides if o.startswith(words) and "cache_dir" not in o]
    return [*data, f"data.cache_dir={tmp_path / 'cache'}"]


def test_training_after_it_reads_no_mesh(cli, arguments, toy_overrides, tmp_path, monkeypatch):
    code, out, err = cli(*arguments, program=preprocess.main)
    assert code == 0, err
    assert re.search(r"12 meshes prepared in \d+\.\d s; cache .*: \d+ MB", out)
    assert not (tmp_path / "outputs").exists()
    monkeypatch.setattr(GeodesicSolver, "row", None)  # distances on the template are there, too
    read, real = [], Folder.load
    monkeypatch.setattr(Folder, "load", lambda self, name: read.append(name) or real(self, name))
    own = [*toy_overrides, *arguments, "optim.epochs=1", "optim.warmup=0", "picture=false"]
    code, out, err = cli(*own, program=train.main)
    assert code == 0, err
    assert set(read) == {"val_0"}  # drawn in TensorBoard


def test_several_data_sets_leave_nothing_outside_outputs(cli, arguments, tmp_path):
    code, out, err = cli("-m", *arguments, "seq_len=8,9", program=preprocess.main)
    assert code == 0 and out.count("12 meshes prepared") == 2, err
    assert {path.name for path in tmp_path.iterdir()} == {"outputs", "cache"}


def test_the_rest_of_the_cache_can_be_removed(cli, arguments, tmp_path):
    """What was prepared counts as read, although it was there before; all else is old."""
    remeshed = ["data/remesh=isotropic", "data.remesh.vertices=100"]
    cli(*arguments, *remeshed, program=preprocess.main)
    wanted = entries(tmp_path / "cache")
    cli(*arguments, "seq_len=9", program=preprocess.main)
    cli(*arguments, "data.shot.bins=5", program=preprocess.main)
    assert wanted < entries(tmp_path / "cache")
    a_day_ago = time.time() - 86400
    for path in (tmp_path / "cache").glob("*/*"):
        os.utime(path, (a_day_ago, a_day_ago))
    cli(*arguments, *remeshed, program=preprocess.main)
    code, _, err = cli(f"cache_dir={tmp_path / 'cache'}", "unused_days=0.5", program=cache.main)
    assert code == 0, err
    assert entries(tmp_path / "cache") == wanted


def entries(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.glob("*/*")}


@pytest.mark.parametrize(
    "word, message",
    [
        ("scheduler=tcp://127.0.0.1:1", "scheduler=tcp://127.0.0.1:1: no Dask scheduler answers"),
        ("scheduler=here", "scheduler=here: no Dask scheduler answers"),
        ("neighbourhood=grid", "Could not find 'neighbourhood/grid'"),
        ("model=fcs", "unknown setting model"),
    ],
)
def test_a_mistake_is_one_line(cli, arguments, word, message, monkeypatch):
    monkeypatch.setattr("meshspiral.data.pool.CONNECT", 1.0)
    code, out, err = cli(*arguments, word, program=preprocess.main)
    assert code in (1, 2) and message in (out + err) and "Traceback" not in out + err


def slow_job(folder: str, item: int) -> int:
    """Notes that it begins, and that it ends, in files that all workers append to."""
    note(folder, "begun", item)
    time.sleep(0.3)
    note(folder, "done", item)
    return item * item


def note(folder: str, what: str, item: int) -> None:
    with open(Path(folder) / what, "a") as file:
        file.write(f"{item} {os.getpid()}\n")


def notes(folder: Path, what: str) -> list[list[int]]:
    path = folder / what
    lines = path.read_text().splitlines() if path.exists() else []
    return [list(map(int, line.split())) for line in lines]


@pytest.fixture
def cluster():
    distributed = pytest.importorskip("distributed", reason="pip install 'dask[distributed]'")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, processes=True
    ) as local:
        yield local


def test_a_cluster_loses_nothing_when_a_worker_is_killed(cluster, tmp_path):
    def kill() -> None:
        while not notes(tmp_path, "done"):
            time.sleep(0.05)
        os.kill(notes(tmp_path, "begun")[0][1], signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    with on_cluster(cluster.scheduler_address):
        results = run_all(partial(slow_job, str(tmp_path)), range(40), None, "Jobs")
    killer.join()
    assert results == [item * item for item in range(40)]
    begun, done = (Counter(item for item, _ in notes(tmp_path, w)) for w in ("begun", "done"))
    assert set(done) == set(range(40))
    assert sum(begun.values()) < 40 + 8  # only what the killed worker had is computed again
    processes = {process for _, process in notes(tmp_path, "done")}
    assert len(processes) >= 2 and os.getpid() not in processes


def test_a_cluster_fills_the_cache_with_the_same_results(cli, cluster, arguments, tmp_path):
    """One of its two workers is killed after the first result."""
    assert cli(*arguments, program=preprocess.main)[0] == 0
    alone = contents(tmp_path / "cache")
    other = tmp_path / "shared"

    def kill() -> None:
        while not any(other.rglob("*.safetensors")):
            time.sleep(0.01)
        os.kill(cluster.workers[0].pid, signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    address = f"scheduler={cluster.scheduler_address}"
    code, _, err = cli(*arguments, f"data.cache_dir={other}", address, program=preprocess.main)
    killer.join()
    assert code == 0, err
    assert contents(other) == alone and len(alone) > 20


def contents(folder: Path) -> dict[str, list]:
    """The arrays of every file, since the order of a file's header is not fixed."""
    return {
        str(path.relative_to(folder)): [
            (name, array.tolist()) for name, array in sorted(load(path.read_bytes()).items())
        ]
        for path in folder.rglob("*.safetensors")
    }


def test_a_cluster_needs_dask(monkeypatch):
    import builtins

    real = builtins.__import__

    def without(name, *rest):
        if name == "distributed":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with (
        pytest.raises(DataError, match=r"pip install 'dask\[distributed\]'"),
        on_cluster("tcp://a"),
    ):
        pass
