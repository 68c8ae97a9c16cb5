"""What a training step consists of, and what it costs in seconds and bytes."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from meshspiral.benchmarking.reference import PlainNetwork
from meshspiral.nn.geodesic import GeodesicConv, Resampling
from meshspiral.nn.layers import SpiralLinear, SpiralLSTM
from meshspiral.nn.loss import ROWS, linear_cross_entropy
from meshspiral.nn.networks import FCSNet, Network

Action = Callable[[], object]
SCALE = 23.3  # of descriptors, as in conf/


def medians(actions: dict[str, Action], repeats: int, device: str = "cpu") -> dict[str, float]:
    """Seconds of each action: the median of `repeats`, taken in turn after a round untimed."""
    seconds: dict[str, list[float]] = {name: [] for name in actions}
    for turn in range(repeats + 1):
        for name, action in actions.items():
            _wait(device)
            began = time.perf_counter()
            action()
            _wait(device)
            if turn:
                seconds[name].append(time.perf_counter() - began)
    return {name: statistics.median(values) for name, values in seconds.items()}


def _wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def fast_loss(net: Network, features: Tensor, neighbourhood: Tensor | Resampling, labels: Tensor):
    x = net.embed(features, neighbourhood)
    return linear_cross_entropy(x, net.head.weight, net.head.bias, labels)


def training_step(net: nn.Module, loss: Callable[[], Tensor], precision: str = "32-true") -> Action:
    """Forward, backward and Adam."""
    adam = torch.optim.Adam(net.parameters(), lr=1e-4)
    device = next(net.parameters()).device.type

    def step() -> None:
        adam.zero_grad()
        with torch.autocast(device, torch.bfloat16, enabled=precision == "bf16-mixed"):
            value = loss()
        value.backward()
        adam.step()

    return step


class Product(NamedTuple):
    """`count` products [batch, rows, inner] x [batch, inner, columns]."""

    count: int
    batch: int
    rows: int
    inner: int
    columns: int

    @property
    def operations(self) -> int:
        return 2 * self.count * self.batch * self.rows * self.inner * self.columns


def products(net: Network, vertices: int, seq_len: int) -> list[Product]:
    """The matrix products of a training step, forward and backward."""
    found = _linear(vertices, net.lift.in_features, net.lift.out_features)[::2]  # not by the input
    for layer in net.layers:
        if isinstance(layer, SpiralLinear):
            found += _linear(vertices, layer.linear.in_features, layer.linear.out_features)
        elif isinstance(layer, SpiralLSTM):
            width, steps = layer.hidden.in_features, seq_len - 1
            found += _linear(vertices, layer.input.in_features, 4 * width)
            found += [
                Product(steps, 1, vertices, width, 4 * width),
                Product(steps, 1, vertices, 4 * width, width),
                Product(1, 1, 4 * width, steps * vertices, width),
            ]
        elif isinstance(layer, GeodesicConv):
            outs, rays, rings, channels = layer.weight.shape
            found += _linear(vertices, 2 * rings * channels, 2 * outs, batch=rays // 2)
    found += _linear(vertices, net.neck.in_features, net.neck.out_features)
    chunks, inner, classes = -(-vertices // ROWS), net.head.in_features, net.head.out_features
    return found + [product._replace(count=chunks) for product in _linear(ROWS, inner, classes)]


def _linear(rows: int, inner: int, columns: int, batch: int = 1) -> list[Product]:
    """The result, and the gradients by the input and by the weights."""
    return [
        Product(1, batch, rows, inner, columns),
        Product(1, batch, rows, columns, inner),
        Product(1, batch, inner, rows, columns),
    ]


def multiply(found: list[Product], device: str, dtype: torch.dtype) -> Action:
    """An action that does these products and nothing else."""
    operands = []
    for count, batch, rows, inner, columns in found:
        a = torch.randn(batch, rows, inner, device=device).to(dtype)
        b = torch.randn(batch, inner, columns, device=device).to(dtype)
        operands.append(
            (count, a, b, torch.empty(batch, rows, columns, device=device, dtype=dtype))
        )

    def action() -> None:
        for count, a, b, out in operands:
            for _ in range(count):
                torch.bmm(a, b, out=out)

    return action


def in_own_process(function: Callable, *arguments):
    """What a function gives in a fresh process: its memory is its own."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def peak_bytes(action: Action) -> int | None:
    """By how much this process's memory grew at most while it ran; None where the system can't say
    (other than Linux)."""
    status = Path("/proc/self/status")
    if not status.exists():
        return None
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
    before = _bytes("VmRSS")
    action()
    return _bytes("VmHWM") - before


def _bytes(what: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(what):
            return 1024 * int(line.split()[1])
    raise KeyError(what)


def random_inputs(vertices: int, classes: int, seq_len: int):
    """Features, spirals of nearby vertices, labels: for sizes of which there is no body."""
    torch.manual_seed(0)
    near = torch.randint(-200, 200, (vertices, seq_len))
    spirals = (torch.arange(vertices)[:, None] + near) % vertices
    return torch.randn(vertices, 544) / SCALE, spirals, torch.randint(classes, (vertices,))


def step_memory(vertices: int, classes: int, seq_len: int, ours: bool):
    """(seconds, bytes) of one forward and backward pass of FCS-NET; gradients included."""
    torch.set_flush_denormal(True)
    features, spirals, labels = random_inputs(vertices, classes, seq_len)
    net = FCSNet(544, classes, seq_len, feature_scale=SCALE)
    plain = None if ours else PlainNetwork(net)

    def step() -> None:
        if ours:
            loss = fast_loss(net, features, spirals, labels)
        else:
            loss = plain.loss(features, spirals, labels)
        loss.backward()

    began = time.perf_counter()
    peak = peak_bytes(step)
    return time.perf_counter() - began, peak
