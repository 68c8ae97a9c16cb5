"""How the cost of a pass grows with each of its sizes."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
import torch

from meshspiral.benchmarking.inputs import network_of, torus_batch
from meshspiral.benchmarking.measure import Action, Row, in_own_process, medians, peak_bytes
from meshspiral.benchmarking.memory import too_large
from meshspiral.data.progress import Progress
from meshspiral.data.tensors import draw
from meshspiral.experiment.schema import BenchmarkConfig, TrainConfig, load_plugins
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.nn.loss import linear_cross_entropy
from meshspiral.nn.networks import Network
from meshspiral.nn.networks.three_layers import LAST
from meshspiral.training.device import keep_freed_memory, set_up_process

SIZES = [1500, 3000, 6000, 12_000, 25_000, 50_000, 100_000]
LENGTHS = [10, 15, 20, 30, 40, 60]
LONGEST = 600.0  # seconds of one size
TEMPLATE = 1500  # vertices of the template where it does not grow


class Series(NamedTuple):
    """One size that grows.

    Attributes:
        network: The network without its last layer; None for the last layer and its cross-entropy.
        over: "vertices", "N" or "template".
        sizes: The values of that size, ascending.
    """

    network: TrainConfig | None
    over: str
    sizes: list[int]

    @property
    def what(self) -> str:
        """The network's title, or "head"."""
        return "head" if self.network is None else Network.registered[self.network.model.name].title


def all_series(networks: list[TrainConfig]) -> list[Series]:
    """Each network over the vertices, and over N if its neighbourhood has `seq_len`; the head over
    the vertices and over the template."""
    return [
        *(Series(network, "vertices", SIZES) for network in networks),
        Series(None, "vertices", SIZES),
        *(Series(n, "N", LENGTHS) for n in networks if hasattr(n.neighbourhood, "seq_len")),
        Series(None, "template", SIZES),
    ]


def scaling_rows(config: BenchmarkConfig, networks: list[TrainConfig]) -> list[Row]:
    """A row for each series: its sizes, and the cost of one forward and backward pass at each.

    "MB" are those beyond parameters and inputs; None on systems other than Linux. The exponents are
    those of the upper half of the sizes. A series stops before a size that would take more than
    half of the free memory, by extrapolation in proportion, or longer than `LONGEST`, preparation
    included, as the last two sizes grew; "stopped" says where.
    """
    rows = []
    for series in all_series(networks):
        costs: list[tuple[float, float | None]] = []
        taken: list[float] = []  # seconds, preparation included
        stopped = ""
        for size in Progress(series.sizes, desc=f"{series.what} over {series.over}"):
            if costs:
                known = series.sizes[: len(costs)]
                ratio, used = size / known[-1], costs[-1][1]
                if used is not None and too_large(1e6 * used * ratio):
                    stopped = f"before {size:,}: about {used * ratio / 1e3:.1f} GB"
                    break
                power = exponent(known[-2:], taken[-2:]) or 1.0
                if (expected := taken[-1] * ratio**power) > LONGEST:
                    stopped = f"before {size:,}: about {expected / 60:.0f} minutes"
                    break
            began = time.perf_counter()
            costs.append(in_own_process(pass_cost, config, series, size))
            taken.append(time.perf_counter() - began)
        seconds, megabytes = (list(values) for values in zip(*costs, strict=True))
        sizes = series.sizes[: len(costs)]
        rows.append(
            {
                "what": series.what,
                "over": series.over,
                "sizes": sizes,
                "exponent of seconds": exponent(sizes, seconds),
                "seconds": seconds,
                "exponent of MB": exponent(sizes, megabytes),
                "MB": megabytes,
                "stopped": stopped,
            }
        )
    return rows


def exponent(sizes: list[int], values: list[float | None]) -> float | None:
    """The slope of a line through the upper half of the values, both axes logarithmic.

    The line goes through two values at least.

    Returns:
        The slope; None if a value is missing, or if there is only one.
    """
    if None in values or len(values) < 2:
        return None
    upper = slice(min(len(sizes) // 2, len(sizes) - 2), None)
    return float(np.polyfit(np.log(sizes[upper]), np.log(values[upper]), 1)[0])


def pass_cost(config: BenchmarkConfig, series: Series, size: int) -> tuple[float, float | None]:
    """The cost of one pass, to be called in a process of its own.

    Returns:
        Seconds and megabytes.
    """
    load_plugins(config.plugins)
    set_up_process(config.threads)
    action = one_pass(series, size, config.vertices)
    peak = peak_bytes(action)
    keep_freed_memory()  # as in training; earlier, it would hide memory that is used again
    seconds = medians({"pass": action}, config.repeats)["pass"]
    return seconds, None if peak is None else peak / 1e6


def one_pass(series: Series, size: int, vertices: int) -> Action:
    """An action: a forward and a backward pass.

    Args:
        series: What to measure.
        size: The value of the size that grows.
        vertices: Number of vertices where it does not grow.
    """
    network = series.network
    if series.over == "vertices":
        vertices = size
    if network is None:
        return head_pass(vertices, size if series.over == "template" else TEMPLATE)
    if series.over == "N":
        around = network.neighbourhood.model_copy(update={"seq_len": size})
        network = network.model_copy(update={"neighbourhood": around})
    batch = torus_batch(network, vertices, TEMPLATE)
    batch = draw(Neighbourhood.of(network.neighbourhood), batch, network.seed)
    net = network_of(network, num_classes=10)
    return lambda: net.embed_batch(batch).sum().backward()


def head_pass(vertices: int, template: int) -> Action:
    """The same for the last layer and its cross-entropy, on random inputs."""
    x = torch.randn(vertices, LAST).requires_grad_()
    weight = (torch.randn(template, LAST) / LAST**0.5).requires_grad_()
    bias = torch.zeros(template).requires_grad_()
    labels = torch.randint(template, (vertices,))
    return lambda: linear_cross_entropy(x, weight, bias, labels).backward()
