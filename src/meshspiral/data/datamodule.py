"""One mesh per batch, and a fresh spiral around every vertex each time it is served."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from functools import cached_property
from itertools import chain

import lightning as L
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler
from tqdm import tqdm

from meshspiral.data.cache import Arrays, Store, digest
from meshspiral.data.preprocessing import (
    Recipe,
    by_rows_and_columns,
    descriptor_task,
    load_task,
    neighbourhood_task,
    run_tasks,
)
from meshspiral.data.reference import ReferenceDistances
from meshspiral.data.shapes import SPLITS, DataError, Shape, ShapeSet
from meshspiral.geometry.mesh import Mesh

log = logging.getLogger(__name__)

Batch = dict[str, torch.Tensor | int | dict[str, torch.Tensor]]


def derived_seed(*parts: int | str) -> int:
    """A seed for one purpose: the same parts give the same number, other parts another."""
    return int(digest(*parts)[:15], 16)


def draw_spirals(
    sequences: torch.Tensor, first: torch.Tensor, generator: torch.Generator | None = None
) -> torch.Tensor:
    """For every vertex one of its spirals, each start equally likely: int64 [V, N].

    sequences: int [R, N] and first: int64 [V+1], a `SpiralTable` on any device; the generator must
    be on the same one.
    """
    starts = first.diff()
    draw = torch.rand(len(starts), device=first.device, generator=generator)
    # rand < 1, but the product of a large float32 below 1 and the count may round up to the count
    step = (draw * starts).long().clamp(max=starts - 1)
    return sequences.index_select(0, first[:-1] + step).long()


def rotate(batch: Batch, *purpose: int | str) -> Batch:
    """The batch with one spiral of every vertex in the place of the spiral table, if it has one,
    drawn from (purpose, mesh) alone."""
    if "sequences" not in batch:
        return batch
    batch = dict(batch)
    sequences, first = batch.pop("sequences"), batch.pop("first")
    generator = torch.Generator(first.device)
    generator.manual_seed(derived_seed(*purpose, batch["index"]))
    batch["spirals"] = draw_spirals(sequences, first, generator)
    return batch


def described_tensors(arrays: Arrays, mesh: Mesh, recipe: Recipe) -> Batch:
    """`features`, `vertices` and `unit` of `MeshDataset`; arrays: of a `descriptor_task`."""
    centred = mesh.vertices - mesh.vertices.mean(axis=0)  # float32 has no digits left far away
    return {
        "features": torch.from_numpy(arrays["features"]),
        "vertices": torch.from_numpy(centred.astype(np.float32)),
        "unit": torch.tensor(recipe.shot_radius * np.sqrt(mesh.area), dtype=torch.float32),
    }


def neighbourhood_tensors(arrays: Arrays, mesh: Mesh, recipe: Recipe) -> Batch:
    """The neighbourhoods of `MeshDataset`; arrays: of a `neighbourhood_task`."""
    if recipe.patch is None:
        return _tensors(arrays)
    return {"patches": _tensors(by_rows_and_columns(arrays, len(mesh.vertices)))}


class MeshDataset(Dataset):
    """The tensors of one split. Item i is a dictionary, without a batch dimension:

    features float32 [V, C]; labels int64 [V]; vertices float32 [V, 3]; unit float32 [], the length
    that metric information is divided by; index int, i; the neighbourhoods: either sequences
    int32 [R, N] and first int64 [V+1], the spiral table, or patches, see `by_rows_and_columns`;
    and corners int64 [V, 3] and weights float64 [V, 3] where the truth is a point of a face.
    """

    def __init__(self, names: list[str], items: list[Batch]):
        self.names, self.items = names, items

    def __len__(self) -> int:
        return len(self.items)

    def __getitem__(self, i: int) -> Batch:
        return {**self.items[i], "index": i}


class EpochSampler(Sampler[int]):
    """A fresh order in every epoch, the same for the same seed and epoch.

    rank of world: of several processes, this one serves every world-th item. They need equally
    many, so where the size does not divide, the first items of the order stand at its end again.
    skip: leaves out as many of this process's items at the beginning of the first epoch served:
    those that a run had done before it was stopped.
    """

    def __init__(self, size: int, seed: int, skip: int = 0, rank: int = 0, world: int = 1):
        self.size, self.seed, self.skip, self.epoch = size, seed, skip, 0
        self.rank, self.world = rank, world

    def set_epoch(self, epoch: int) -> None:
        """Called by Lightning before each epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        return -(-self.size // self.world)

    def __iter__(self) -> Iterator[int]:
        order = np.random.default_rng([self.seed, self.epoch]).permutation(self.size)
        order = np.resize(order, len(self) * self.world)[self.rank :: self.world].tolist()
        skip, self.skip = self.skip, 0
        yield from order[skip:]


class CorrespondenceData(L.LightningDataModule):
    """A data set as batches of one mesh, with the spirals of this iteration or with patches.

    Each batch is an item of `MeshDataset` on the device of the run, with `spirals` int64 [V, N]
    in the place of a spiral table. In training the start of every spiral is drawn anew in every
    iteration, from (seed, epoch, mesh) alone: an interrupted run goes on with the very draws it
    would have made. In validation and test it is drawn from (seed, mesh): figures are repeatable.

    shuffle_vertices renumbers every mesh at random when it is read.
    """

    def __init__(
        self,
        shapes: ShapeSet,
        recipe: Recipe,
        store: Store,
        seed: int = 0,
        shuffle_vertices: bool = False,
        workers: int | None = None,
    ):
        super().__init__()
        self.shapes, self.recipe, self.store = shapes, recipe, store
        self.seed, self.shuffle_vertices, self.workers = seed, shuffle_vertices, workers
        self.datasets: dict[str, MeshDataset] = {}
        self._skip = 0

    @property
    def num_classes(self) -> int:
        return len(self.shapes.template.vertices)

    @property
    def resolution(self) -> int:
        """The number of vertices of a training mesh, the median."""
        return int(np.median([len(item["labels"]) for item in self.datasets["train"].items]))

    @property
    def in_features(self) -> int:
        return 32 * (self.recipe.shot_bins + 1)

    @cached_property
    def reference(self) -> ReferenceDistances:
        """Distances on the template, in units of the square root of its area."""
        return ReferenceDistances(self.shapes.template, self.store)

    def shape(self, name: str) -> Shape:
        """A shape as it is served: renumbered, if shuffle_vertices says so."""
        shape = self.shapes.load(name)
        if not self.shuffle_vertices:
            return shape
        rng = np.random.default_rng(derived_seed(self.seed, "shuffle", name))
        order = rng.permutation(len(shape.labels))
        return shape.renumbered(order)

    def setup(self, stage: str | None = None) -> None:
        splits = {"fit": ("train", "val"), "validate": ("val",), "test": ("test",)}
        wanted = [s for s in splits.get(stage, SPLITS) if s not in self.datasets]
        self.prepare(wanted)

    def prepare(self, wanted: list[str] | tuple[str, ...] = SPLITS) -> None:
        """Read the meshes of those splits, compute what is not on disk yet, and load it."""
        for split in wanted:
            if not self.shapes.names[split]:
                raise DataError(f"no mesh to {split}: the data set's split has none")
        names = [(split, name) for split in wanted for name in self.shapes.names[split]]
        self.shapes.prepare([name for _, name in names])
        shapes, tasks = [], []
        for _, name in tqdm(names, desc="Meshes", unit="mesh", delay=1.0):
            shape = self.shape(name)
            shapes.append(shape)
            described = descriptor_task(shape.mesh, self.recipe)
            tasks.append((described, neighbourhood_task(shape.mesh, self.recipe)))
        what = "Descriptors and " + ("patches" if self.recipe.patch else "spirals")
        run_tasks(chain(*tasks), self.store, self.workers, what)
        loaded: dict[str, Batch] = {}  # meshes share the spirals they have alike
        items: dict[str, list[Batch]] = {split: [] for split in wanted}
        progress = tqdm(
            zip(names, shapes, tasks, strict=True),
            total=len(names),
            desc="Loading",
            unit="mesh",
            delay=1.0,
        )
        for (split, name), shape, (descriptors, neighbourhoods) in progress:
            if neighbourhoods.key not in loaded:
                arrays = load_task(neighbourhoods, self.store)
                loaded[neighbourhoods.key] = neighbourhood_tensors(arrays, shape.mesh, self.recipe)
            described = load_task(descriptors, self.store)
            if undefined := int(described["undefined"]):
                log.warning(
                    "%s: no descriptor at %d of %d vertices; zeros stand there",
                    name,
                    undefined,
                    len(shape.labels),
                )
            item = described_tensors(described, shape.mesh, self.recipe)
            item |= loaded[neighbourhoods.key]
            item["labels"] = torch.from_numpy(shape.labels)
            if shape.points is not None:
                item |= _tensors(shape.points._asdict())
            items[split].append(item)
        for split in wanted:
            self.datasets[split] = MeshDataset(self.shapes.names[split], items[split])

    def train_dataloader(self) -> DataLoader:
        skip, self._skip = self._skip, 0
        rank, world = self._place()
        sampler = EpochSampler(len(self.datasets["train"]), self.seed, skip, rank, world)
        return DataLoader(self.datasets["train"], batch_size=None, sampler=sampler)

    def val_dataloader(self) -> DataLoader:
        return self._in_order("val")

    def test_dataloader(self) -> DataLoader:
        return self._in_order("test")

    def _in_order(self, split: str) -> DataLoader:
        """Every mesh once, divided among the processes."""
        rank, world = self._place()
        size = len(self.datasets[split])
        if size < world:
            raise DataError(f"{world} processes can't share the {size} meshes to {split}")
        return DataLoader(self.datasets[split], batch_size=None, sampler=range(rank, size, world))

    def _place(self) -> tuple[int, int]:
        trainer = self.trainer
        return (trainer.global_rank, trainer.world_size) if trainer is not None else (0, 1)

    def on_after_batch_transfer(self, batch: Batch, dataloader_idx: int) -> Batch:
        if "sequences" not in batch:
            return batch
        trainer = self.trainer
        when = f"epoch {trainer.current_epoch}" if trainer.training else "evaluation"
        return rotate(batch, self.seed, "spirals", when)

    def state_dict(self) -> dict[str, int]:
        progress = self.trainer.fit_loop.epoch_loop.batch_progress.current
        done = progress.completed
        return {"skip": 0 if done >= self.trainer.num_training_batches else done}

    def load_state_dict(self, state: dict[str, int]) -> None:
        self._skip = state["skip"]


def _tensors(arrays: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(array) for name, array in arrays.items()}
