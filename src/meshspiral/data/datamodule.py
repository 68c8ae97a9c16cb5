"""One mesh per batch, with a fresh draw of its neighbourhoods each time it is served."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import chain

import lightning as L
import numpy as np
import torch
from scipy.sparse import csr_array
from torch.utils.data import DataLoader, Dataset, Sampler
from tqdm import tqdm

from meshspiral.data.cache import Arrays, Cache
from meshspiral.data.descriptors import Features
from meshspiral.data.preprocessing import (
    compute_task,
    descriptor_task,
    frame_task,
    load_task,
    neighbourhood_task,
    run_tasks,
)
from meshspiral.data.reference import ReferenceDistances
from meshspiral.data.shapes import SPLITS, DataError, Shape, ShapeSet
from meshspiral.geometry.digest import derived_seed
from meshspiral.geometry.mesh import Mesh
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.neighbourhoods.base import Batch

log = logging.getLogger(__name__)


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
    columns = [torch.from_numpy(described["features"]) for described in arrays]
    return {
        "features": columns[0] if len(columns) == 1 else torch.cat(columns, dim=1),
        "vertices": torch.from_numpy(mesh.centred.astype(np.float32)),
        "unit": torch.tensor(features.unit * np.sqrt(mesh.area), dtype=torch.float32),
    }


def mesh_tensors(mesh: Mesh, features: Features, neighbourhood: Neighbourhood) -> Batch:
    """All entries of `MeshDataset` but the labels, for one mesh, without the cache."""
    tasks = [descriptor_task(mesh, descriptor) for descriptor in features.descriptors]
    described = [compute_task(task) for task in tasks]
    arrays = compute_task(neighbourhood_task(mesh, neighbourhood))
    batch = described_tensors(described, mesh, features)
    return batch | neighbourhood_tensors(mesh, neighbourhood, arrays)


def neighbourhood_tensors(
    mesh: Mesh, neighbourhood: Neighbourhood, arrays: Arrays, cache: Cache | None = None
) -> Batch:
    """The tensors of a neighbourhood for one mesh.

    Args:
        mesh: The surface.
        neighbourhood: Whose `tensors` are wanted.
        arrays: The result of its `neighbourhood_task`.
        cache: Where local frames are read from, or computed into; None for no cache.
    """
    if neighbourhood.frame is None:
        return neighbourhood.tensors(arrays, mesh)
    task = frame_task(mesh, neighbourhood.frame)
    frames = compute_task(task) if cache is None else load_task(task, cache)
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
    row = spirals[vertex].numpy()
    row = row[row >= 0]
    if places is None:
        return mesh.vertices[row]
    shape = (len(places["first"]) - 1, len(mesh.vertices))
    blend = csr_array((places["weights"], places["vertices"], places["first"]), shape=shape)
    return (blend @ mesh.vertices)[row]


class MeshDataset(Dataset):
    """The tensors of one split. Item i is a dictionary, without a batch dimension.

    Entries:
        features: float32 [V, C], the descriptors.
        labels: int64 [V], vertices of the template.
        vertices: float32 [V, 3], centred.
        unit: float32 [], the length by which metric information is divided.
        index: int, i.
        corners, weights: int64 [V, 3] and float64 [V, 3], only where the true point lies within a
            face of the template: its vertices, and barycentric coordinates.
        and those that the neighbourhood's `tensors` returns.
    """

    def __init__(self, names: list[str], items: list[Batch]):
        self.names, self.items = names, items

    def __len__(self) -> int:
        return len(self.items)

    def __getitem__(self, i: int) -> Batch:
        return {**self.items[i], "index": i}


class EpochSampler(Sampler[int]):
    """A random order for every epoch, which depends on seed and epoch alone.

    All processes of a run need equally many items: where the size does not divide, the first items
    of the order are repeated at its end.

    Args:
        size: Number of items.
        seed: Seed of the order.
        skip: Number of items of this process to leave out at the start of the first epoch served:
            those that a run had done before it was stopped.
        rank: Number of this process.
        world: Number of processes; this one serves every world-th item.
    """

    def __init__(self, size: int, seed: int, skip: int = 0, rank: int = 0, world: int = 1):
        self.size, self.seed, self.skip, self.epoch = size, seed, skip, 0
        self.rank, self.world = rank, world

    def set_epoch(self, epoch: int) -> None:
        """Lightning calls this before each epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        return -(-self.size // self.world)

    def __iter__(self) -> Iterator[int]:
        order = np.random.default_rng([self.seed, self.epoch]).permutation(self.size)
        order = np.resize(order, len(self) * self.world)[self.rank :: self.world].tolist()
        skip, self.skip = self.skip, 0
        yield from order[skip:]


class CorrespondenceData(L.LightningDataModule):
    """A data set as batches of one mesh, with neighbourhoods drawn for this iteration.

    Each batch is an item of `MeshDataset` on the run's device, after the neighbourhood's `draw`. In
    training, random choices are new in every iteration and depend on (seed, epoch, mesh) alone, so
    a resumed run makes the choices that an uninterrupted one would have made. In validation and
    test they depend on (seed, mesh): metrics are repeatable.

    Args:
        shapes: The data set.
        features: The descriptors.
        neighbourhood: What the network reads around a vertex.
        cache: Where descriptors, tables and distances are cached.
        seed: Seed of the order of meshes and of all draws.
        shuffle_vertices: Renumber the vertices of every mesh at random when it is read.
        workers: Number of processes that compute what is not cached; None for one per core.
    """

    def __init__(
        self,
        shapes: ShapeSet,
        features: Features,
        neighbourhood: Neighbourhood,
        cache: Cache,
        seed: int = 0,
        shuffle_vertices: bool = False,
        workers: int | None = None,
    ):
        super().__init__()
        self.shapes, self.features = shapes, features
        self.neighbourhood, self.cache = neighbourhood, cache
        self.seed, self.shuffle_vertices, self.workers = seed, shuffle_vertices, workers
        self.datasets: dict[str, MeshDataset] = {}
        self._skip = 0

    @property
    def num_classes(self) -> int:
        """Number of vertices of the template."""
        return len(self.shapes.template.vertices)

    @property
    def resolution(self) -> int:
        """The median number of vertices of a training mesh."""
        return int(np.median([len(item["labels"]) for item in self.datasets["train"].items]))

    @property
    def in_features(self) -> int:
        """Number of channels of the descriptors."""
        return self.features.channels

    @cached_property
    def reference(self) -> ReferenceDistances:
        """Distances on the template, in units of the square root of its area."""
        return ReferenceDistances(self.shapes.template, self.cache)

    def shape(self, name: str) -> Shape:
        """A shape as it is served: renumbered if `shuffle_vertices` is true."""
        shape = self.shapes.load(name)
        if not self.shuffle_vertices:
            return shape
        rng = np.random.default_rng(derived_seed(self.seed, "shuffle", name))
        return shape.renumbered(rng.permutation(len(shape.labels)))

    def setup(self, stage: str | None = None) -> None:
        splits = {"fit": ("train", "val"), "validate": ("val",), "test": ("test",)}
        wanted = [s for s in splits.get(stage, SPLITS) if s not in self.datasets]
        self.prepare(wanted)

    def prepare(self, wanted: list[str] | tuple[str, ...] = SPLITS) -> None:
        """Read the meshes of these splits, compute what is not cached, and load everything.

        Raises:
            DataError: A split has no mesh, or a shape is wrong.
            MeshError: A mesh cannot be read or described.
            CacheError: The cache cannot be written.
        """
        for split in wanted:
            if not self.shapes.names[split]:
                raise DataError(f"the split {split} must have at least 1 mesh, got 0")
        names = [(split, name) for split in wanted for name in self.shapes.names[split]]
        self.shapes.prepare([name for _, name in names])
        shapes, tasks = [], []
        for _, name in tqdm(names, desc="Meshes", unit="mesh", delay=1.0):
            shape = self.shape(name)
            self._check_size(name, len(shape.labels))
            shapes.append(shape)
            described = [descriptor_task(shape.mesh, each) for each in self.features.descriptors]
            tasks.append((*described, neighbourhood_task(shape.mesh, self.neighbourhood)))
        what = f"Descriptors and {self.neighbourhood.noun}"
        run_tasks(chain(*tasks), self.cache, self.workers, what)
        repeated = Counter(table.key for *_, table in tasks)
        loaded: dict[str, Arrays] = {}  # tables of several meshes, which share them
        items: dict[str, list[Batch]] = {split: [] for split in wanted}
        progress = tqdm(
            zip(names, shapes, tasks, strict=True),
            total=len(names),
            desc="Loading",
            unit="mesh",
            delay=1.0,
        )
        for (split, name), shape, (*descriptors, table) in progress:
            arrays = loaded.get(table.key)
            if arrays is None:
                arrays = load_task(table, self.cache)
                if repeated[table.key] > 1:
                    loaded[table.key] = arrays
            described = [load_task(task, self.cache) for task in descriptors]
            for task, result in zip(descriptors, described, strict=True):
                if undefined := int(result["undefined"]):
                    log.warning(
                        "%s: %s is undefined at %d of %d vertices; using zeros",
                        name,
                        task.kind.upper(),
                        undefined,
                        len(shape.labels),
                    )
            item = described_tensors(described, shape.mesh, self.features)
            item |= neighbourhood_tensors(shape.mesh, self.neighbourhood, arrays, self.cache)
            item["labels"] = torch.from_numpy(shape.labels)
            if shape.points is not None:
                points = shape.points._asdict()
                item |= {key: torch.from_numpy(array) for key, array in points.items()}
            items[split].append(item)
        for split in wanted:
            self.datasets[split] = MeshDataset(self.shapes.names[split], items[split])

    def _check_size(self, name: str, vertices: int) -> None:
        least = self.neighbourhood.least_vertices
        if least > vertices:
            raise DataError(
                f"{name}: {self.neighbourhood.noun} must have at most the {vertices:,} vertices of "
                f"the mesh, got {least:,}"
            )

    def train_dataloader(self) -> DataLoader:
        skip, self._skip = self._skip, 0
        rank, world = self._rank_and_world()
        sampler = EpochSampler(len(self.datasets["train"]), self.seed, skip, rank, world)
        return DataLoader(self.datasets["train"], batch_size=None, sampler=sampler)

    def val_dataloader(self) -> DataLoader:
        return self._in_order("val")

    def test_dataloader(self) -> DataLoader:
        return self._in_order("test")

    def _in_order(self, split: str) -> DataLoader:
        """Every mesh once, divided among the processes."""
        rank, world = self._rank_and_world()
        size = len(self.datasets[split])
        if size < world:
            raise DataError(
                f"the split {split} must have a mesh for each of {world} processes, got {size}"
            )
        return DataLoader(self.datasets[split], batch_size=None, sampler=range(rank, size, world))

    def _rank_and_world(self) -> tuple[int, int]:
        trainer = self.trainer
        return (trainer.global_rank, trainer.world_size) if trainer is not None else (0, 1)

    def on_after_batch_transfer(self, batch: Batch, dataloader_idx: int) -> Batch:
        training = self.trainer.training
        when = f"epoch {self.trainer.current_epoch}" if training else "evaluation"
        return draw(self.neighbourhood, batch, self.seed, "spirals", when, training=training)

    def state_dict(self) -> dict[str, int]:
        progress = self.trainer.fit_loop.epoch_loop.batch_progress.current
        done = progress.completed
        return {"skip": 0 if done >= self.trainer.num_training_batches else done}

    def load_state_dict(self, state: dict[str, int]) -> None:
        self._skip = state["skip"]
