"""One mesh per batch, with a fresh draw of its neighbourhoods each time it is served."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from itertools import islice

import lightning as L
import numpy as np
import torch
from torch.utils._pytree import tree_leaves
from torch.utils.data import DataLoader, Dataset, Sampler

from meshspiral.data.cache import Arrays, Cache
from meshspiral.data.descriptors import Features
from meshspiral.data.prepared import Prepared, Recipe
from meshspiral.data.reference import ReferenceDistances
from meshspiral.data.shapes import SPLITS, DataError, Shape, ShapeSet
from meshspiral.data.tensors import draw
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.neighbourhoods.base import Batch

KEPT = 2**29  # bytes of a split that stay in memory


class MeshDataset(Dataset):
    """The tensors of one split. Item i is a dictionary, without a batch dimension.

    Items are read when they are asked for. The first ones stay in memory, up to `KEPT` bytes.

    Entries:
        features: float32 [V, C], the descriptors.
        labels: int64 [V], vertices of the template.
        vertices: float32 [V, 3], centred.
        unit: float32 [], the length by which metric information is divided.
        index: int, i.
        corners, weights: int64 [V, 3] and float64 [V, 3], only where the true point lies within a
            face of the template: its vertices, and barycentric coordinates.
        and those that the neighbourhood's `tensors` returns.

    Args:
        recipe: By which items are read.
        prepared: The shapes of the split.
        tables: Keys of the tables that several shapes have, with the tables once they are read.

    Attributes:
        names: Names of the shapes.
        sizes: Their numbers of vertices, int64 [M].
        kept: Bytes of the items in memory.
    """

    def __init__(
        self, recipe: Recipe, prepared: Sequence[Prepared], tables: dict[str, Arrays | None]
    ):
        self.names = [each.name for each in prepared]
        self.sizes = np.array([each.vertices for each in prepared])
        self._recipe, self._prepared = recipe, prepared
        self._items: dict[int, Batch] = {}
        self.kept, self._tables = 0, tables

    def __len__(self) -> int:
        return len(self._prepared)

    def __getitem__(self, i: int) -> Batch:
        if i not in range(len(self)):
            raise IndexError(f"{i} must be an item, 0..{len(self) - 1}")
        item = self._items.get(i)
        if item is None:
            item = self._recipe.read(self._prepared[i], self._tables)
            size = sum(t.nbytes for t in tree_leaves(item) if isinstance(t, torch.Tensor))
            if self.kept + size <= KEPT:
                self.kept += size
                self._items[i] = item
        return {**item, "index": i}


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
        half: Keep descriptors as float16 in the cache.
        readers: Number of processes that read meshes ahead of the steps; None for one if the
            meshes do not fit into `KEPT` bytes of memory, else none.
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
        half: bool = False,
        readers: int | None = None,
    ):
        super().__init__()
        self.shapes, self.features = shapes, features
        self.neighbourhood, self.cache = neighbourhood, cache
        self.seed, self.workers, self.readers = seed, workers, readers
        shuffle = seed if shuffle_vertices else None
        self.recipe = Recipe(shapes, features, neighbourhood, cache, shuffle, half)
        self.datasets: dict[str, MeshDataset] = {}
        self._skip = 0

    @property
    def num_classes(self) -> int:
        """Number of vertices of the template."""
        return len(self.shapes.template.vertices)

    @property
    def resolution(self) -> int:
        """The median number of vertices of a training mesh."""
        return int(np.median(self.datasets["train"].sizes))

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
        return self.recipe.shape(name)

    def setup(self, stage: str | None = None) -> None:
        splits = {"fit": ("train", "val"), "validate": ("val",), "test": ("test",)}
        wanted = [s for s in splits.get(stage, SPLITS) if s not in self.datasets]
        self.prepare(wanted)

    def prepare(self, wanted: list[str] | tuple[str, ...] = SPLITS) -> None:
        """Compute what is not cached for these splits.

        Raises:
            DataError: A split has no mesh, or a shape is wrong.
            MeshError: A mesh cannot be read or described.
            CacheError: The cache cannot be written.
        """
        for split in wanted:
            if not self.shapes.names[split]:
                raise DataError(f"the split {split} must have at least 1 mesh, got 0")
        names = [name for split in wanted for name in self.shapes.names[split]]
        prepared = self.recipe.prepare_all(names, self.workers)
        repeated = Counter(each.table for each in prepared)
        tables = {key: None for key, count in repeated.items() if count > 1}
        rest = iter(prepared)
        for split in wanted:
            of_split = list(islice(rest, len(self.shapes.names[split])))
            self.datasets[split] = MeshDataset(self.recipe, of_split, tables)

    def train_dataloader(self) -> DataLoader:
        skip, self._skip = self._skip, 0
        rank, world = self._rank_and_world()
        sampler = EpochSampler(len(self.datasets["train"]), self.seed, skip, rank, world)
        return self._loader("train", sampler)

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
        return self._loader(split, range(rank, size, world))

    def _loader(self, split: str, sampler: Iterable[int]) -> DataLoader:
        dataset = self.datasets[split]
        readers = self.readers
        if readers is None:
            item = dataset[0]
            size = sum(t.nbytes for t in tree_leaves(item) if isinstance(t, torch.Tensor))
            readers = int(size * dataset.sizes.sum() / dataset.sizes[0] > KEPT)
        # forked processes could hang in libraries that had started threads
        ahead = {"multiprocessing_context": "spawn", "persistent_workers": True} if readers else {}
        return DataLoader(dataset, batch_size=None, sampler=sampler, num_workers=readers, **ahead)

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
