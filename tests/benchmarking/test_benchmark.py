"""The benchmark measures what it says."""

import json
import re
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from meshspiral.benchmarking import measure, memory, scaling, steps, waiting
from meshspiral.benchmarking import preprocessing as preprocessing_part
from meshspiral.benchmarking.inputs import torus_batch
from meshspiral.benchmarking.products import ProductRecorder
from meshspiral.benchmarking.reference import reference_loss, reference_network
from meshspiral.benchmarking.table import table_lines
from meshspiral.commands import benchmark
from meshspiral.data.datasets.bodies import Bodies
from meshspiral.data.tensors import draw
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.nn.networks import Network
from tests.helpers import ROOT, composed


def small(model, *overrides):
    channels = "model.channels=[24,25,26]"
    return composed([f"model={model}", channels, "seq_len=4", "data.shot.bins=1", *overrides])


def test_actions_are_timed_in_turn_after_an_untimed_round():
    done = []
    actions = {"a": lambda: done.append("a"), "b": lambda: (done.append("b"), time.sleep(0.02))}
    seconds = measure.medians(actions, 3)
    assert done == ["a", "b"] * 4
    assert seconds["a"] < 0.01 < 0.02 <= seconds["b"] < 0.2


def peaks():
    """Megabytes of an action, of nothing, and of the action after a lot of memory was freed."""
    ones = measure.peak_bytes(lambda: np.ones(50 * 2**20, np.uint8).sum())
    nothing = measure.peak_bytes(lambda: None)
    blocks = [bytearray(50_000) for _ in range(2000)]  # too small for the system to take back
    del blocks
    again = measure.peak_bytes(lambda: [bytearray(50_000) for _ in range(1000)])
    return [peak / 2**20 for peak in (ones, nothing, again)]


@pytest.mark.skipif(sys.platform != "linux", reason="memory is measured on Linux only")
def test_the_peak_of_memory_is_that_of_the_action():
    ones, nothing, again = measure.in_own_process(peaks)
    assert 49 < ones < 90
    assert nothing < 10
    assert 45 < again < 90


def killed():
    import os
    import signal

    os.kill(os.getpid(), signal.SIGKILL)


def test_a_killed_process_is_one_clear_error():
    with pytest.raises(ChildProcessError, match="killed, probably out of memory"):
        measure.in_own_process(killed)


def test_a_step_trains_and_so_does_its_reference():
    config = small("fcs")
    batch = draw(Neighbourhood.of(config.neighbourhood), torus_batch(config, 50, 20), 0)
    net = steps.network_of(config, 20)
    copy = reference_network(net)
    before = net.head.weight.detach().clone()
    for each, loss in ((net, steps.training_loss), (copy, reference_loss)):
        step = steps.training_step(each, lambda each=each, loss=loss: loss(each, batch))
        step()
        assert not torch.equal(before, each.head.weight)


@pytest.fixture
def three_bodies(monkeypatch):
    """The bundled set with one body in each split."""
    shapes = Bodies(1500)
    shapes.names = {split: names[:1] for split, names in shapes.names.items()}
    monkeypatch.setattr(preprocessing_part, "open_shapes", lambda _: shapes)


@pytest.fixture
def small_sizes(monkeypatch):
    monkeypatch.setattr(memory, "LARGE", (60, 90))
    monkeypatch.setattr(scaling, "SIZES", [40, 60, 90])
    monkeypatch.setattr(scaling, "LENGTHS", [2, 4, 6])
    monkeypatch.setattr(waiting, "MESHES", 2)


def test_every_part_has_its_table_and_its_entry_in_the_file(
    cli, tmp_path, three_bodies, small_sizes
):
    words = ["vertices=1500", "seq_len=4", "repeats=1", "threads=1", "hydra.run.dir=out"]
    code, out, err = cli(*words, "models=[fcs,gcnn3]", program=benchmark.main)
    assert code == 0, err
    result = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    config_parts = ["steps", "memory", "preprocessing", "waiting", "scaling"]
    assert result.keys() == {"machine", "config", *config_parts}
    assert result["config"]["seq_len"] == 4
    assert [row["network"] for row in result["steps"]] == ["fcs", "gcnn3"]
    for row in result["steps"]:
        assert row["reference / ours"] == pytest.approx(row["reference ms"] / row["ours ms"])
        assert f"{row['ours / products']:.3f}" in out
        assert row["Gflop"] > 1
    names = [row["what"] for row in result["preprocessing"]]
    assert names[0] == "shot" and names[1] == "spirals of 4 vertices"
    assert names[2].startswith("patches of 5 x 16") and names[3] == "everything"
    for row in result["waiting"]:
        assert row["steps"] == 2 and 0 < row["waiting"] < 0.5 * row["seconds"]
        assert row["waiting / seconds"] == pytest.approx(row["waiting"] / row["seconds"])
    assert {row["template"] for row in result["memory"]} == {1500, 90}
    assert len(result["memory"]) == 6
    assert [(row["what"], row["over"]) for row in result["scaling"]] == [
        ("FCS-NET", "vertices"),
        ("GCNN3", "vertices"),
        ("head", "vertices"),
        ("FCS-NET", "N"),
        ("head", "template"),
    ]
    assert all(len(row["seconds"]) == len(row["MB"]) == 3 for row in result["scaling"])
    assert (tmp_path / "out" / "scaling.png").stat().st_size > 10_000


def test_preprocessing_of_all_bodies_is_omitted_if_it_takes_long(monkeypatch, three_bodies, caplog):
    config = benchmark.BenchmarkConfig.model_construct(repeats=1)
    monkeypatch.setattr(preprocessing_part, "medians", lambda actions, _: dict.fromkeys(actions, 9))
    monkeypatch.setattr(preprocessing_part, "LONGEST", 0.1)
    network = small("fcs", "neighbourhood.start=frame")
    shot, frames, spirals = preprocessing_part.preprocessing_rows(config, [network])
    assert (shot["what"], frames["what"]) == ("shot", "frames of support 0.3, by area")
    assert spirals["what"].startswith("spirals of 4 vertices, from the frame")
    assert "all 3 bodies: omitted, about" in caplog.text


PLUGIN = '''
"""A network of a user: the mean over each spiral, then a linear layer."""

from torch import nn

from meshspiral.nn.networks.spiral_net import SpiralNet


class Mean(nn.Module):
    def __init__(self, in_features, out_features):
        super().__init__()
        self.linear = nn.Linear(in_features, out_features)

    def forward(self, features, spirals, metric=None):
        return self.linear(features[spirals].mean(dim=1))


class MeanNet(SpiralNet, name="mean"):
    title = "MEAN-NET"

    def spiral_layer(self, in_features, out_features, metric):
        return Mean(in_features, out_features)
'''


def test_a_network_of_a_plugin_is_measured(cli, tmp_path, monkeypatch, small_sizes):
    (tmp_path / "mean_plugin.py").write_text(PLUGIN)
    lines = (ROOT / "conf" / "model" / "fcs.yaml").read_text().replace("fcs", "mean")
    (tmp_path / "my_conf" / "model").mkdir(parents=True)
    (tmp_path / "my_conf" / "model" / "mean.yaml").write_text(lines)
    monkeypatch.setattr(sys, "path", sys.path[:])
    monkeypatch.setattr(Network, "registered", dict(Network.registered))
    words = ["--config-dir", "my_conf", "plugins=[mean_plugin]", "models=[mean]", "seq_len=4"]
    small_run = ["vertices=1500", "repeats=1", "parts=[steps]", "hydra.run.dir=out"]
    code, _, err = cli(*words, *small_run, program=benchmark.main)
    sys.modules.pop("mean_plugin", None)
    assert code == 0, err
    result = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    assert [row["network"] for row in result["steps"]] == ["mean"]


def test_the_exponent_is_that_of_the_upper_half():
    sizes = [1, 2, 4, 8, 16, 32]
    assert scaling.exponent(sizes, [1e3, 1e3, 1e3, 64, 256, 1024]) == pytest.approx(2)
    assert scaling.exponent(sizes, [None] * 6) is None
    assert scaling.exponent([1, 2], [5.0, 40.0]) == pytest.approx(3)
    assert scaling.exponent([1], [5.0]) is None


def test_series_are_of_the_networks_asked_for():
    series = [(s.what, s.over) for s in scaling.all_series([small("gcnn3"), small("lstm")])]
    over_vertices = [("GCNN3", "vertices"), ("LSTM-NET", "vertices"), ("head", "vertices")]
    assert series == [*over_vertices, ("LSTM-NET", "N"), ("head", "template")]


@pytest.mark.parametrize(
    "model, over, sizes",
    [
        ("fcs", "vertices", (300, 600)),
        ("lstm", "vertices", (300, 600)),
        ("gcnn3", "vertices", (300, 600)),
        ("fcs", "N", (4, 8)),
        (None, "vertices", (300, 600)),
        (None, "template", (20, 40)),
    ],
)
def test_scaling_is_measured_on_passes_of_the_size_asked_for(model, over, sizes):
    series = scaling.Series(model and small(model), over, list(sizes))
    operations = []
    for size in sizes:
        with ProductRecorder() as recorder:
            scaling.one_pass(series, size, vertices=300)()
        operations.append(recorder.operations)
    once, twice = operations
    # the transform of GCNN3's weights, and the dense layers of FCS-NET, have a constant cost
    least = 1.4 if model == "gcnn3" or over == "N" else 2
    assert 0 < least * once <= twice <= 2 * once


def test_a_series_stops_before_it_takes_half_of_the_free_memory(monkeypatch):
    """A pass takes 1 MB a vertex, and 5 GB are free."""
    monkeypatch.setattr(scaling, "in_own_process", lambda _, config, series, size: (1.0, size))
    monkeypatch.setattr(memory, "free_bytes", lambda: int(5e9))
    config = benchmark.BenchmarkConfig.model_construct(vertices=1500)
    rows = scaling.scaling_rows(config, [])
    assert [row["over"] for row in rows] == ["vertices", "template"]
    for row in rows:
        assert row["sizes"] == [1500] and row["MB"] == [1500]
        assert row["stopped"] == "before 3,000: about 3.0 GB"
        assert row["exponent of MB"] is None
    monkeypatch.setattr(memory, "free_bytes", lambda: None)  # unknown: nothing is left out
    assert scaling.scaling_rows(config, [])[0]["sizes"] == scaling.SIZES


def test_a_series_stops_before_a_size_that_takes_long(monkeypatch):
    """A size takes the cube of itself: 1, 8 and 64 seconds; the next one would take 512."""
    now = [0.0]

    def measured(_, config, series, size):
        now[0] += (size / 10) ** 3
        return 1.0, None

    monkeypatch.setattr(scaling, "in_own_process", measured)
    monkeypatch.setattr(scaling, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    monkeypatch.setattr(scaling, "SIZES", [10, 20, 40, 80, 160])
    monkeypatch.setattr(scaling, "LONGEST", 500.0)
    config = benchmark.BenchmarkConfig.model_construct(vertices=1500)
    for row in scaling.scaling_rows(config, []):
        assert row["sizes"] == [10, 20, 40]
        assert row["stopped"] == "before 80: about 9 minutes"


def test_a_network_too_large_for_the_memory_is_omitted_with_a_warning(monkeypatch, caplog):
    costs = {True: (2.0, 2_000_000_000), False: (1.0, 1_000_000_000)}
    monkeypatch.setattr(memory, "in_own_process", lambda _, n, v, k, ref, t: costs[ref])
    monkeypatch.setattr(memory, "free_bytes", lambda: 10_000_000_000)
    config = benchmark.BenchmarkConfig.model_construct(vertices=1500, threads=1)
    ours, reference, large = memory.memory_rows(config, [small("fcs")])
    assert ours["peak MB"] == 1000 and reference["over ours"] == 2
    assert large["seconds"] is None and large["peak MB"] is None
    assert "fcs at 20000 vertices: omitted, it would take about 13.3 GB" in caplog.text
    title, heads, *lines = table_lines("memory", [ours, reference, large])
    assert title == "\nmemory" and heads.split()[:3] == ["network", "vertices", "template"]
    assert re.fullmatch(r"  fcs +20000 +100000 +True +- +- +-", lines[2])


def test_overrides_are_settings_of_the_networks_to_measure(cli, monkeypatch):
    measured = []
    monkeypatch.setattr(memory, "memory_rows", lambda _, networks: measured.extend(networks) or [])
    words = ["models=[lstm]", "parts=[memory]", "hydra.run.dir=out"]
    cli(*words, program=benchmark.main)
    cli(*words, "overrides=[model.recompute=true]", program=benchmark.main)
    assert [network.model.recompute for network in measured] == [False, True]


@pytest.mark.parametrize(
    "argument, message",
    [
        ("vertices=3", "vertices must be one of 1500, 6890, got 3"),
        ("parts=[naps]", "must be one of steps, memory, preprocessing, waiting, scaling, got naps"),
        ("repeats=0", "repeats must be at least 1, got 0"),
        ("+depth=1", "unknown key depth"),
        ("models=[x]", "models must be of acnn, conv, diffusion, fcs, gcnn3, lstm, monet, got x"),
        ("models=[]", "models must be of acnn, conv, diffusion, fcs, gcnn3, lstm, monet, got none"),
        ("overrides=[model.depth=1]", "Could not override 'model.depth'"),
    ],
)
def test_a_mistake_is_one_clear_line(cli, argument, message):
    code, out, err = cli(argument, program=benchmark.main)
    assert code == 1 and message in (out + err).strip().splitlines()[-1]
