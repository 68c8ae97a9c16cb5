"""The tensors of one mesh, and drawing its neighbourhoods."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.sparse import csr_array

from meshspiral.data.cache import Arrays
from meshspiral.data.descriptors import Features
from meshspiral.data.preprocessing import (
    compute_task,
    descriptor_task,
    frame_task,
    neighbourhood_task,
)
from meshspiral.data.shapes import DataError
from meshspiral.geometry.digest import derived_seed
from meshspiral.geometry.mesh import Mesh
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.neighbourhoods.base import Batch


def draw(
    neighbourhood: Neighbourhood, batch: Batch, *purpose: int | str, training: bool = False
) -> Batch:
    """The batch with the neighbourhoods drawn, by chance that depends on (purpose, mesh) alone.

    Args:
        neighbourhood: Whose tensors the batch holds.
        batch: An item of `MeshDataset`, on any device.
        *purpose: For instance the seed and the epoch.
        training: Whether the batch is trained on.
    """
    generator = torch.Generator(batch["features"].device)
    generator.manual_seed(derived_seed(*purpose, batch["index"]))
    return neighbourhood.draw(batch, generator, training)


def described_tensors(arrays: Sequence[Arrays], mesh: Mesh, features: Features) -> Batch:
    """`features`, `vertices` and `unit` of `MeshDataset`.

    Args:
        arrays: The result of the `descriptor_task` of each descriptor.
        mesh: The mesh that was described.
        features: The descriptors.
    """
    columns = [torch.from_numpy(described["features"]).float() for described in arrays]
    return {
        "features": columns[0] if len(columns) == 1 else torch.cat(columns, dim=1),
        "vertices": torch.from_numpy(mesh.centred.astype(np.float32)),
        "unit": torch.tensor(features.unit * mesh.size, dtype=torch.float32),
    }


def mesh_tensors(mesh: Mesh, features: Features, neighbourhood: Neighbourhood) -> Batch:
    """All entries of `MeshDataset` but the labels, for one mesh, without the cache."""
    tasks = [descriptor_task(mesh, descriptor) for descriptor in features.descriptors]
    described = [compute_task(task) for task in tasks]
    arrays = compute_task(neighbourhood_task(mesh, neighbourhood))
    batch = described_tensors(described, mesh, features)
    return batch | neighbourhood_tensors(mesh, neighbourhood, arrays)


def neighbourhood_tensors(mesh: Mesh, neighbourhood: Neighbourhood, arrays: Arrays) -> Batch:
    """The tensors of a neighbourhood for one mesh.

    Args:
        mesh: The surface.
        neighbourhood: Whose `tensors` are wanted.
        arrays: The result of its `neighbourhood_task`.
    """
    if neighbourhood.frame is None:
        return neighbourhood.tensors(arrays, mesh)
    frames = compute_task(frame_task(mesh, neighbourhood.frame))
    return neighbourhood.tensors(arrays, mesh, frames["frames"])


def sequence_points(mesh: Mesh, neighbourhood: Neighbourhood, vertex: int) -> np.ndarray:
    """The points that the sequence around one vertex visits, as in an evaluation.

    Args:
        mesh: The surface.
        neighbourhood: One that gives `spirals`.
        vertex: The centre.

    Returns:
        float64 [N, 3], without padding; of the first layer if layers differ.

    Raises:
        DataError: The neighbourhood gives no sequences.
    """
    if neighbourhood.gives != "spirals":
        raise DataError(f"{neighbourhood.name} has no sequences; it gives {neighbourhood.gives}")
    arrays = compute_task(neighbourhood_task(mesh, neighbourhood))
    batch = neighbourhood_tensors(mesh, neighbourhood, arrays)
    batch = draw(neighbourhood, {**batch, "features": torch.zeros(1), "index": 0}, 0)
    spirals, places = batch["spirals"], batch.get("places")
    if isinstance(spirals, tuple):
        spirals, places = spirals[0], places and places[0]
    row = spirals[vertex].reshape(-1, spirals.shape[-1])[0].numpy()  # of the first start
    row = row[row >= 0]
    if places is None:
        return mesh.vertices[row]
    shape = (len(places["first"]) - 1, len(mesh.vertices))
    blend = csr_array((places["weights"], places["vertices"], places["first"]), shape=shape)
    return (blend @ mesh.vertices)[row]
