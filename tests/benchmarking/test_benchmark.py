"""The benchmark measures what it says."""

import json
import time

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from meshspiral.benchmarking import measure
from meshspiral.benchmarking import scaling as growth
from meshspiral.benchmarking.reference import PlainNetwork
from meshspiral.commands import benchmark
from meshspiral.nn.networks import GCNN3, FCSNet, LSTMNet
from tests.experiment.test_cli import cli  # noqa: F401
from tests.nn.test_geodesic import as_resampling, patches

SMALL = {"channels": [24, 25, 26], "dropout": 0.0}


def networks(seq_len, classes):
    return {
        "fcs": FCSNet(544, classes, seq_len, **SMALL),
        "lstm": LSTMNet(544, classes, **SMALL),
        "gcnn3": GCNN3(544, classes, **SMALL),
    }


class Products(TorchDispatchMode):
    """Counts the operations of every matrix product, in place and with `out` too."""

    operations = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        if function.overloadpacket.__name__ in ("mm", "bmm", "addmm", "addmm_"):
            a, b = [x for x in args if isinstance(x, torch.Tensor)][-2:]
            self.operations += 2 * a.numel() * b.shape[-1]
        return function(*args, **(kwargs or {}))


def test_actions_are_timed_in_turn_after_an_untimed_round():
    done = []
    actions = {"a": lambda: done.append("a"), "b": lambda: (done.append("b"), time.sleep(0.02))}
    seconds = measure.medians(actions, 3)
    assert done == ["a", "b"] * 4
    assert seconds["a"] < 0.01 < 0.02 <= seconds["b"] < 0.2


@pytest.mark.parametrize("name", ["fcs", "lstm", "gcnn3"])
def test_the_products_of_a_step_are_those_that_it_does(name):
    vertices = measure.ROWS  # one whole chunk of the head
    net = networks(20, 300)[name]
    if name == "gcnn3":
        around = as_resampling(*patches(vertices))
    else:
        around = torch.randint(vertices, (vertices, 20))
    labels = torch.randint(300, (vertices,))
    with Products() as counted:
        measure.fast_loss(net, torch.randn(vertices, 544), around, labels).backward()
    found = sum(product.operations for product in measure.products(net, vertices, 20))
    extra = 0.3 if name == "gcnn3" else 0.0  # Fourier transforms, small where channels are many
    assert found <= counted.operations <= (1 + extra) * found


def two_peaks():
    ones = measure.peak_bytes(lambda: np.ones(50 * 2**20, np.uint8).sum())
    return ones, measure.peak_bytes(lambda: None)


def test_the_peak_of_memory_is_that_of_the_action():
    """In a process that has freed nothing before."""
    ones, nothing = measure.in_own_process(two_peaks)
    assert 49 < ones / 2**20 < 90
    assert nothing < 10 * 2**20


def test_a_plain_step_trains_too():
    net = PlainNetwork(networks(6, 50)["fcs"])
    features, spirals = torch.randn(50, 544), torch.randint(50, (50, 6))
    step = measure.training_step(net, lambda: net.loss(features, spirals, torch.arange(50)))
    before = net.head.weight.detach().clone()
    step()
    assert not torch.equal(before, net.head.weight)


def test_every_part_has_its_table_and_its_place_in_the_file(cli, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.setattr(benchmark, "networks", networks)
    monkeypatch.setattr(benchmark, "LARGE", (60, 90))
    series = [("FCS-NET", "N", [2, 4, 6]), ("head", "template", [9, 33, 99])]
    monkeypatch.setattr(growth, "SERIES", series)
    shapes = benchmark.open_shapes({"name": "bodies", "vertices": 1500})
    shapes.names = {split: names[:1] for split, names in shapes.names.items()}
    monkeypatch.setattr(benchmark, "open_shapes", lambda _: shapes)
    small = ["vertices=1500", "seq_len=4", "repeats=1", "hydra.run.dir=out"]
    code, out, err = cli(*small, program=benchmark.main)
    assert code == 0, err
    result = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    assert result.keys() == {"machine", "config", *benchmark.PARTS}
    for row in result["steps"]:
        assert row["plain / ours"] == pytest.approx(row["plain ms"] / row["ours ms"])
        assert f"{row['ours / products']:.3f}" in out
    assert [row["what"] for row in result["preprocessing"]][-1] == "all three"
    assert {row["template"] for row in result["memory"]} == {1500, 90}
    assert [row["what"] for row in result["growth"]] == ["FCS-NET", "head"]
    assert all(len(row["seconds"]) == len(row["MB"]) == 3 for row in result["growth"])
    assert (tmp_path / "out" / "growth.png").stat().st_size > 10_000


def test_the_exponent_is_that_of_the_upper_half():
    sizes = [1, 2, 4, 8, 16, 32]
    assert growth.exponent(sizes, [1e3, 1e3, 1e3, 64, 256, 1024]) == pytest.approx(2)
    assert growth.exponent(sizes, [None] * 6) is None


@pytest.mark.parametrize("what", ["FCS-NET", "LSTM-NET", "GCNN3", "head"])
def test_growth_is_measured_on_passes_of_the_size_asked_for(what):
    small = {"vertices": 300, "template": 20, "N": 4}
    with Products() as once:
        growth.one_pass(what, **small)()
    with Products() as twice:
        growth.one_pass(what, **small | {"vertices": 600})()
    # the weights of GCNN3 are transformed, however many vertices there are
    assert (1.5 if what == "GCNN3" else 2) * once.operations <= twice.operations
    assert 0 < twice.operations <= 2 * once.operations


@pytest.mark.parametrize(
    "argument, message",
    [
        ("vertices=3", "vertices must be one of 1500, 6890; got 3"),
        ("parts=[naps]", "parts must be of steps, memory, preprocessing, growth; got naps"),
        ("repeats=0", "repeats must be at least 1; got 0"),
        ("+depth=1", "unknown key depth"),
    ],
)
def test_a_mistake_is_one_clear_line(cli, argument, message):  # noqa: F811
    code, out, err = cli(argument, program=benchmark.main)
    assert code == 1 and message in (out + err).strip().splitlines()[-1]
