"""Seconds of a training step, of its reference, and of its matrix products alone."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn

from meshspiral.benchmarking.inputs import body_batch, network_of
from meshspiral.benchmarking.measure import Action, Row, medians
from meshspiral.benchmarking.products import ProductRecorder, replay
from meshspiral.benchmarking.reference import reference_loss, reference_network
from meshspiral.data.progress import Progress
from meshspiral.data.tensors import draw
from meshspiral.experiment.schema import BenchmarkConfig, TrainConfig
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.neighbourhoods.base import Batch
from meshspiral.nn.loss import linear_cross_entropy
from meshspiral.nn.networks import Network
from meshspiral.training.device import choose_precision, device_of


def training_loss(net: Network, batch: Batch) -> Tensor:
    """The loss as in training."""
    head = net.head
    return linear_cross_entropy(net.embed_batch(batch), head.weight, head.bias, batch["labels"])


def training_step(net: nn.Module, loss: Callable[[], Tensor], precision: str = "32-true") -> Action:
    """An action: forward pass, backward pass and Adam.

    Args:
        net: Whose parameters are trained.
        loss: Runs the forward pass.
        precision: Lightning's name of the precision, "32-true" or "bf16-mixed".
    """
    adam = torch.optim.Adam(net.parameters(), lr=1e-4)
    device = next(net.parameters()).device.type

    def step() -> None:
        adam.zero_grad()
        with torch.autocast(device, torch.bfloat16, enabled=precision == "bf16-mixed"):
            value = loss()
        value.backward()
        adam.step()

    return step


def step_rows(config: BenchmarkConfig, networks: list[TrainConfig]) -> list[Row]:
    """A row for each network: milliseconds on one body, and their ratios.

    Columns: "ours", the step in the chosen precision; "reference", that of `reference_network` in
    float32; "products", the matrix products of our step alone; "draw", the random choices of the
    neighbourhood; "Gflop", 1e9 multiplications and additions of the products.
    """
    device = device_of(config.accelerator)
    precision = choose_precision(config.precision, config.accelerator)
    rows = []
    for network in Progress(networks, desc="Steps"):
        neighbourhood = Neighbourhood.of(network.neighbourhood)
        drawing = partial(draw, neighbourhood, body_batch(network, device), network.seed)
        batch = drawing()
        net = network_of(network, config.vertices).to(device)
        reference = reference_network(net)
        ours = training_step(net, partial(training_loss, net, batch), precision)
        with ProductRecorder() as recorder:
            ours()
        seconds = medians(
            {
                "ours": ours,
                "reference": training_step(reference, partial(reference_loss, reference, batch)),
                "products": replay(recorder.products, device),
                "draw": drawing,
            },
            config.repeats,
            device,
        )
        rows.append(
            {
                "network": network.model.name,
                "precision": precision,
                **{f"{name} ms": 1e3 * value for name, value in seconds.items()},
                "reference / ours": seconds["reference"] / seconds["ours"],
                "ours / products": seconds["ours"] / seconds["products"],
                "draw / ours": seconds["draw"] / seconds["ours"],
                "Gflop": recorder.operations / 1e9,
            }
        )
    return rows
