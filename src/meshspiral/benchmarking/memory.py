"""Peak memory of a forward and backward pass."""

from __future__ import annotations

import logging
import time

from meshspiral.benchmarking.inputs import network_of, torus_batch
from meshspiral.benchmarking.measure import Row, in_own_process, peak_bytes
from meshspiral.benchmarking.reference import reference_loss, reference_network
from meshspiral.benchmarking.steps import training_loss
from meshspiral.data.progress import Progress
from meshspiral.data.tensors import draw
from meshspiral.experiment.schema import BenchmarkConfig, TrainConfig, load_plugins
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.training.device import set_up_process
from meshspiral.training.memory import free_bytes

log = logging.getLogger(__name__)

LARGE = (20_000, 100_000)  # vertices of a mesh and of a template


def too_large(expected: float | None) -> bool:
    """Whether something would take more than half of the free memory.

    Half, because `expected` is extrapolated in proportion: where memory grows with the square of a
    size, the true value at twice the size is twice as large.

    Args:
        expected: Bytes; None if unknown, which is never too large.
    """
    free = free_bytes()
    return expected is not None and free is not None and expected > free / 2


def memory_rows(config: BenchmarkConfig, networks: list[TrainConfig]) -> list[Row]:
    """Three rows for each network: ours, its reference, and ours at the sizes `LARGE`.

    "peak MB" are those beyond parameters and inputs, gradients included, of a process of its own;
    None on systems other than Linux. A network that would take more than half of the free memory
    at `LARGE` has None there, by extrapolation in proportion to the vertices.
    """
    rows: list[Row] = []
    for network in Progress(networks, desc="Memory"):
        size = config.vertices
        ours = in_own_process(pass_cost, network, size, size, False, config.threads)
        reference = in_own_process(pass_cost, network, size, size, True, config.threads)
        expected = ours[1] and ours[1] * LARGE[0] / size
        if too_large(expected):
            large = None, None
            log.warning(
                "%s at %d vertices: omitted, it would take about %.1f GB",
                network.model.name,
                LARGE[0],
                expected / 1e9,
            )
        else:
            large = in_own_process(pass_cost, network, *LARGE, False, config.threads)
        for vertices, template, is_ours, (seconds, peak) in (
            (size, size, True, ours),
            (size, size, False, reference),
            (*LARGE, True, large),
        ):
            rows.append(
                {
                    "network": network.model.name,
                    "vertices": vertices,
                    "template": template,
                    "ours": is_ours,
                    "seconds": seconds,
                    "peak MB": peak and peak / 1e6,
                    "over ours": peak and peak / ours[1],
                }
            )
    return rows


def pass_cost(
    network: TrainConfig, vertices: int, num_classes: int, reference: bool, threads: int | None
) -> tuple[float, int | None]:
    """The cost of one forward and backward pass, to be called in a process of its own.

    Args:
        network: The network.
        vertices: Number of vertices of the mesh.
        num_classes: Number of vertices of the template.
        reference: Whether to measure the reference network.
        threads: Number of threads; None for one per core.

    Returns:
        Seconds, the first use of everything included, and the peak in bytes beyond parameters and
        inputs, or None.
    """
    load_plugins(network.plugins)
    set_up_process(threads)
    batch = torus_batch(network, vertices, num_classes)
    batch = draw(Neighbourhood.of(network.neighbourhood), batch, network.seed)
    net, loss = network_of(network, num_classes), training_loss
    if reference:
        net, loss = reference_network(net), reference_loss
    began = time.perf_counter()
    peak = peak_bytes(lambda: loss(net, batch).backward())
    return time.perf_counter() - began, peak
