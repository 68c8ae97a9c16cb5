"""The estimate of memory before training: against measured peaks, its warning, and its cost."""

from __future__ import annotations

import logging
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from meshspiral.benchmarking.inputs import channels, network_of, torus_batch
from meshspiral.benchmarking.measure import in_own_process
from meshspiral.benchmarking.memory import pass_cost
from meshspiral.data.descriptors import Features
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.nn.networks import FCSNet
from meshspiral.training import memory
from meshspiral.training.memory import Estimate, estimate_memory, free_bytes, memory_lines
from tests.helpers import composed, run, same_weights

VERTICES = 1500


class OneMesh(list):
    """What the estimate reads of a data set with one mesh."""

    kept = 0

    @property
    def sizes(self) -> np.ndarray:
        return np.array([len(self[0]["labels"])])


def a_network(overrides: list[str], vertices: int = VERTICES):
    """A network, and what the estimate reads of a data module with one mesh."""
    config = composed(overrides)
    data = SimpleNamespace(
        datasets={"train": OneMesh([torus_batch(config, vertices, vertices)])},
        neighbourhood=Neighbourhood.of(config.neighbourhood),
        in_features=channels(config),
        features=Features.of(config.data),
        seed=0,
    )
    return config, network_of(config, vertices), data


@pytest.mark.parametrize(
    "overrides, least, most",
    [
        (["model=fcs"], 0.5, 1.5),  # a quarter of the peak is the system's own
        (["model=lstm"], 0.8, 1.3),
        (["model=lstm", "model.recompute=true"], 0.6, 1.5),
        (["model=lstm", "neighbourhood.rings=2"], 0.8, 1.5),
        (["model=gcnn3"], 0.6, 1.6),
    ],
    ids=str,
)
def test_the_estimate_agrees_with_the_measured_peak_of_a_pass(overrides, least, most):
    """Of a process of its own, as the system counts it."""
    config, net, data = a_network(overrides)
    growth = estimate_memory(net, data, "32-true").growth
    adam = 2 * sum(4 * p.numel() for p in net.parameters())
    _, peak = in_own_process(pass_cost, config, VERTICES, VERTICES, False, 1)
    if peak is None:
        pytest.skip("the system does not say")
    print(f"{overrides}: {(growth - adam) / peak:.2f} of {peak / 1e6:.0f} MB")
    assert least < (growth - adam) / peak < most


def test_long_spirals_are_foreseen_without_taking_their_memory():
    """Twenty gigabytes on 1500 vertices, from a pass that takes a hundredth of them."""
    _, net, data = a_network(["model=lstm", "seq_len=1400", "model.channels=[20,30,40]"], 42)
    [item] = data.datasets["train"]
    data.datasets["train"][0] = {**item, "labels": torch.zeros(VERTICES, dtype=torch.int64)}
    tallies = []
    original = memory._Tally.__exit__

    def note(self, *error):
        tallies.append(self.peak)
        return original(self, *error)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(memory._Tally, "__exit__", note)
        growth = estimate_memory(net, data, "32-true").growth
    states = 1400 * VERTICES * 6 * (20 + 30 + 40) * 4  # gates, cells and hidden states
    assert states > 4e9
    assert 1.0 < growth / states < 1.5
    assert max(tallies) < states / 70


@pytest.mark.parametrize("precision, ratio", [("64-true", 2.0), ("bf16-mixed", 1.28)])
def test_the_estimate_knows_the_precision(precision, ratio):
    _, net, data = a_network(["model=lstm"], 162)
    found = estimate_memory(net, data, precision).growth
    assert found / estimate_memory(net, data, "32-true").growth == pytest.approx(ratio, rel=0.1)
    assert next(net.parameters()).dtype == torch.float32


def test_nothing_of_training_is_changed_by_the_estimate(toy_overrides, tmp_path, monkeypatch):
    _, net, data = a_network(["model=fcs"], 162)
    before, numpys = torch.get_rng_state(), np.random.get_state()[1].copy()
    weights = [p.clone() for p in net.parameters()]
    net.eval()
    assert estimate_memory(net, data, "32-true").growth > 0
    assert torch.equal(torch.get_rng_state(), before) and not net.training
    assert (np.random.get_state()[1] == numpys).all()
    assert all(map(torch.equal, weights, net.parameters()))
    assert all(p.grad is None for p in net.parameters())

    run(tmp_path / "with", [*toy_overrides, "optim.epochs=1"])
    monkeypatch.setattr("meshspiral.training.run.estimate_memory", lambda *_: None)
    run(tmp_path / "without", [*toy_overrides, "optim.epochs=1"])
    assert same_weights(tmp_path / "with", tmp_path / "without")


def test_a_network_that_refuses_small_meshes_trains_without_an_estimate(monkeypatch):
    def refuse(self, batch):
        raise IndexError

    _, net, data = a_network(["model=fcs"], 42)
    monkeypatch.setattr(FCSNet, "embed_batch", refuse)
    assert estimate_memory(net, data, "32-true") is None
    assert list(memory_lines(None, 1)) == []


def levels(estimate: Estimate, *arguments) -> list[int]:
    return [level for level, _ in memory_lines(estimate, *arguments)]


def test_a_warning_says_when_memory_is_short():
    large = Estimate(10**9, 21 * 10**9)
    (_, line), (level, warning) = memory_lines(large, 16 * 10**9)
    assert line.startswith("memory: about 22.00 GB at the peak, of which training adds 21.00 GB")
    assert level == logging.WARNING
    assert "needs about 21.00 GB, but 16.00 GB are free" in warning
    assert levels(large, 22 * 10**9) == levels(large, None) == [logging.INFO]
    assert levels(large, 20 * 10**9, "cuda") == [logging.INFO, logging.WARNING]


def test_the_estimate_is_logged_before_the_first_step(toy_overrides, tmp_path, caplog, monkeypatch):
    caplog.set_level(logging.INFO)
    monkeypatch.setattr("meshspiral.training.run.free_bytes_on", lambda device: 1000)
    monkeypatch.setattr(
        "lightning.Trainer.fit", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt)
    )
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, toy_overrides)
    assert "memory: about " in caplog.text and "training needs about " in caplog.text


# ----------------------------------------------------------------------------------- this machine


def made(root: Path, files: dict[str, str]) -> Path:
    for name, text in {"proc/meminfo": "MemAvailable: 4000 kB\n", **files}.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


V2, V1 = "sys/fs/cgroup", "sys/fs/cgroup/memory"


def group(folder: str, limit: str, used: int, cached: int, names=("memory.max", "memory.current")):
    key = "inactive_file" if names[0] == "memory.max" else "total_inactive_file"
    return {
        f"{folder}/{names[0]}": f"{limit}\n",
        f"{folder}/{names[1]}": f"{used}\n",
        f"{folder}/memory.stat": f"anon 7\n{key} {cached}\n",
    }


OLD = ("memory.limit_in_bytes", "memory.usage_in_bytes")


@pytest.mark.parametrize(
    "files, expected",
    [
        ({}, 4_096_000),
        (group(V2, "max", 9, 0), 4_096_000),
        (group(V2, "3000000", 1_000_000, 500_000), 2_500_000),
        (group(V2, "9000000", 1_000_000, 0), 4_096_000),
        (group(V2, "1000", 2000, 0), 0),
        (
            {"proc/self/cgroup": "0::/a/b\n"}
            | group(f"{V2}/a/b", "max", 9, 0)
            | group(f"{V2}/a", "2000", 500, 0)
            | group(f"{V2}/c", "5", 0, 0),
            1500,
        ),
        (
            {"proc/self/cgroup": "4:memory:/job\n3:cpu:/other\n"}
            | group(f"{V1}/job", "3000", 1000, 100, OLD),
            2100,
        ),
    ],
)
def test_free_memory_respects_control_groups(tmp_path, files, expected):
    assert free_bytes(made(tmp_path, files)) == expected


def test_free_memory_is_unknown_without_proc(tmp_path):
    assert free_bytes(tmp_path) is None
