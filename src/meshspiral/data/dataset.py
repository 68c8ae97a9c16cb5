"""The meshes of one split, read when they are served, and the order of an epoch."""

from __future__ import annotations

import signal
import weakref
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch.utils._pytree import tree_leaves
from torch.utils.data import DataLoader, Dataset, Sampler, get_worker_info

from meshspiral.data.cache import Arrays
from meshspiral.data.prepared import Prepared, Recipe
from meshspiral.data.shapes import name_in
from meshspiral.neighbourhoods.base import Batch

KEPT = 2**29  # bytes of a split that stay in memory


class MeshDataset(Dataset):
    """The tensors of one split. Item i is a dictionary, without a batch dimension.

    Items are read when they are asked for. The first ones stay in memory, up to `KEPT` bytes, but
    not in a reader process: for each tensor that it sent and keeps, it holds a file open. Item
    i + e M, for M shapes and e > 0, is shape i in the version of epoch e, see `name_in`. What the
    cache lacks for it is computed when it is asked for.

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

    def __iter__(self) -> Iterator[Batch]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, i: int) -> Batch:
        epoch, i = divmod(i, len(self))
        if epoch < 0 or (epoch and not self._recipe.shapes.fresh):
            given = i + epoch * len(self)
            raise IndexError(f"{given} must be an item, 0..{len(self) - 1}")
        if epoch:
            prepared = self._recipe.prepare(name_in(epoch, self.names[i]))
            return {**self._recipe.read(prepared, self._tables), "index": i}
        item = self._items.get(i)
        if item is None:
            item = self._recipe.read(self._prepared[i], self._tables)
            size = item_bytes(item)
            if self.kept + size <= KEPT and get_worker_info() is None:
                self.kept += size
                self._items[i] = item
        return {**item, "index": i}


def item_bytes(item: Batch) -> int:
    """The bytes of an item's tensors."""
    return sum(leaf.nbytes for leaf in tree_leaves(item) if isinstance(leaf, torch.Tensor))


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
        fresh: Whether later epochs have versions of their own of the items, see `MeshDataset`.
    """

    def __init__(
        self,
        size: int,
        seed: int,
        skip: int = 0,
        rank: int = 0,
        world: int = 1,
        fresh: bool = False,
    ):
        self.fresh = fresh
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
        version = self.epoch * self.size if self.fresh else 0
        yield from (version + i for i in order[skip:])


def end_readers(loader: weakref.ref[DataLoader]) -> None:
    """End the readers of a loader; at exit, Python itself would wait for those that ignore SIGTERM.

    Args:
        loader: If it still exists.
    """
    for reader in getattr(getattr(loader(), "_iterator", None), "_workers", ()):
        reader.kill()


def ignore_signals(reader: int) -> None:
    """Leave Ctrl-C and SIGTERM, which reach all processes of a group, to the one that trains.

    Args:
        reader: Number of the process that reads.
    """
    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, signal.SIG_IGN)
