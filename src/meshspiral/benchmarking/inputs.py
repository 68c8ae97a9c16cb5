"""What networks are measured on: a body of the bundled set, or a torus of any size."""

from __future__ import annotations

import numpy as np
import torch
from lightning.fabric.utilities import move_data_to_device

from meshspiral.data.descriptors import Features
from meshspiral.data.fitting import fitted_to
from meshspiral.data.preprocessing import compute_task, neighbourhood_task
from meshspiral.data.shapes import Shape
from meshspiral.data.sources import open_shapes
from meshspiral.data.tensors import described_tensors, mesh_tensors, neighbourhood_tensors
from meshspiral.experiment.schema import TrainConfig
from meshspiral.geometry.mesh import Mesh
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.neighbourhoods.base import Batch
from meshspiral.nn.networks import Network
from meshspiral.training.module import build_network


def network_of(config: TrainConfig, num_classes: int) -> Network:
    """The network of a config, as in training."""
    return build_network(config, channels(config), num_classes)


def channels(config: TrainConfig) -> int:
    """Number of channels of the descriptors."""
    return Features.of(config.data).channels


def first_body(config: TrainConfig) -> Shape:
    """The first training shape of the config's data set."""
    shapes = open_shapes(config.data)
    return shapes.load(shapes.names["train"][0])


def body_batch(config: TrainConfig, device: str) -> Batch:
    """The batch of the first training shape, as in training, with nothing drawn yet."""
    shape = first_body(config)
    neighbourhood = Neighbourhood.of(config.neighbourhood)
    features = fitted_to(Features.of(config.data), [shape.mesh])
    batch = mesh_tensors(shape.mesh, features, neighbourhood)
    batch |= {"labels": torch.from_numpy(shape.labels), "index": 0}
    return move_data_to_device(batch, device)


def torus_batch(config: TrainConfig, vertices: int, num_classes: int) -> Batch:
    """A batch of any size, with nothing drawn yet.

    Neighbourhoods are those of a torus; descriptors and labels are random.

    Args:
        config: The neighbourhood, and the number of channels.
        vertices: Number of vertices of the torus, at least 7.
        num_classes: Number of vertices of the template.
    """
    rng = np.random.default_rng(0)
    features = rng.standard_normal((vertices, channels(config)), dtype=np.float32)
    features /= channels(config) ** 0.5  # of length 1, as SHOT
    labels = torch.from_numpy(rng.integers(num_classes, size=vertices))
    mesh, neighbourhood = torus(vertices), Neighbourhood.of(config.neighbourhood)
    arrays = compute_task(neighbourhood_task(mesh, neighbourhood))
    return {
        **described_tensors([{"features": features}], mesh, Features.of(config.data)),
        **neighbourhood_tensors(mesh, neighbourhood, arrays),
        "labels": labels,
        "index": 0,
    }


def torus(vertices: int) -> Mesh:
    """A closed surface of genus 1 with any number of vertices V, each of valence 6.

    Vertices lie on one closed line that winds around the tube about every m = sqrt(V / 2) vertices.
    Vertex i is joined to i + 1, i + m and i + m + 1, modulo V.

    Args:
        vertices: Number of vertices V, at least 7.
    """
    i = np.arange(vertices)
    m = max(2, round((vertices / 2) ** 0.5))
    turns = i / vertices
    around_tube, around_axis = 2 * np.pi * round(vertices / m) * turns, 2 * np.pi * turns
    radius = 2 + np.cos(around_tube)
    points = [radius * np.cos(around_axis), radius * np.sin(around_axis), np.sin(around_tube)]
    triangles = np.stack([i, i + m + 1, i + 1]), np.stack([i, i + m, i + m + 1])
    return Mesh(np.stack(points, 1), np.concatenate(triangles, 1).T % vertices, "torus")
