"""How the cost of a step grows with the sizes of its parts."""

from __future__ import annotations

import numpy as np
import torch
from tqdm import tqdm

from meshspiral.benchmarking import measure
from meshspiral.data.preprocessing import by_rows_and_columns
from meshspiral.nn.geodesic import Resampling
from meshspiral.nn.loss import linear_cross_entropy
from meshspiral.nn.networks import GCNN3, FCSNet, LSTMNet
from meshspiral.training.memory import keep_freed_memory

VERTICES, TEMPLATE, LENGTH = 6890, 1500, 20  # what does not grow
SIZES = [1500, 3000, 6000, 12_000, 25_000, 50_000, 100_000]
LENGTHS = [10, 15, 20, 30, 40, 60]
# (what, over, sizes); LSTM-NET keeps all its steps for its gradient: 25,000 vertices take 8 GB
SERIES = [
    ("FCS-NET", "vertices", SIZES),
    ("LSTM-NET", "vertices", SIZES[:5]),
    ("GCNN3", "vertices", SIZES),
    ("head", "vertices", SIZES),
    ("FCS-NET", "N", LENGTHS),
    ("LSTM-NET", "N", LENGTHS),
    ("head", "template", SIZES),
]


def growth(repeats: int) -> list[dict[str, object]]:
    """For each series: seconds and megabytes of one forward and backward pass at each size, and
    their exponents over the upper half of the sizes.

    Networks are without their last layer, which is "head", with its cross-entropy. Megabytes are
    those beyond parameters and inputs; None where the system can't say.
    """
    rows = []
    for what, over, sizes in SERIES:
        row: dict[str, object] = {"what": what, "over": over, "sizes": sizes}
        found = [
            measure.in_own_process(cost, what, over, size, repeats)
            for size in tqdm(sizes, desc=f"{what} over {over}")
        ]
        for unit, values in zip(("seconds", "MB"), zip(*found, strict=True), strict=True):
            row[f"exponent of {unit}"] = exponent(sizes, values)
            row[unit] = values
        rows.append(row)
    return rows


def exponent(sizes: list[int], values: list[float | None]) -> float | None:
    """The slope of a line through the upper half, both axes logarithmic."""
    upper = slice(len(sizes) // 2, None)
    if None in values:
        return None
    return float(np.polyfit(np.log(sizes[upper]), np.log(values[upper]), 1)[0])


def cost(what: str, over: str, size: int, repeats: int) -> tuple[float, float | None]:
    """(seconds, megabytes) of one pass, in a process that has done nothing else."""
    torch.set_flush_denormal(True)
    action = one_pass(what, **{over: size})
    peak = measure.peak_bytes(action)
    keep_freed_memory()  # as in training; before, it would have hidden memory that is used again
    seconds = measure.medians({"it": action}, repeats)["it"]
    return seconds, None if peak is None else peak / 1e6


def one_pass(what: str, vertices: int = VERTICES, template: int = TEMPLATE, N: int = LENGTH):
    """An action: forward and backward, on random inputs of these sizes."""
    features, spirals, labels = measure.random_inputs(vertices, template, N)
    if what == "head":
        x = features[:, :256].clone().requires_grad_()
        weight, bias = (torch.randn(template, 256) / 16).requires_grad_(), torch.zeros(template)
        return lambda: linear_cross_entropy(x, weight, bias, labels).backward()
    make = {
        "FCS-NET": lambda: FCSNet(544, 10, N, feature_scale=measure.SCALE),
        "LSTM-NET": lambda: LSTMNet(544, 10, feature_scale=measure.SCALE),
        "GCNN3": lambda: GCNN3(544, 10, feature_scale=measure.SCALE),
    }
    net = make[what]()
    around = random_patches(vertices) if what == "GCNN3" else spirals
    return lambda: net.embed(features, around).sum().backward()


def random_patches(vertices: int, rings: int = 5, rays: int = 16) -> Resampling:
    """Samples of three vertices nearby, for sizes of which there is no body."""
    rng = np.random.default_rng(0)
    samples = vertices * rings * rays
    centres = np.repeat(np.arange(vertices), 3 * rings * rays)
    indices = (centres + rng.integers(-200, 200, 3 * samples)) % vertices
    arrays = {
        "indices": indices.astype(np.int32),
        "weights": np.full(3 * samples, 1 / 3, np.float32),
        "first": 3 * np.arange(samples + 1, dtype=np.int32),
    }
    columns = by_rows_and_columns(arrays, vertices)
    return Resampling(**{name: torch.from_numpy(array) for name, array in columns.items()})
