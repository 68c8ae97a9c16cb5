"""One mesh per batch, with a fresh draw of its neighbourhoods each time it is served."""

from __future__ import annotations

import atexit
import weakref
from collections import Counter
from collections.abc import Iterable
from functools import cached_property
from itertools import islice
from typing import Any

import lightning as L
import numpy as np
import torch
from joblib import cpu_count
from torch.utils.data import DataLoader

from meshspiral.data.cache import Cache
from meshspiral.data.dataset import (
    KEPT,
    EpochSampler,
    MeshDataset,
    end_readers,
    ignore_signals,
    item_bytes,
)
from meshspiral.data.descriptors import Features
from meshspiral.data.prepared import Recipe
from meshspiral.data.reference import ReferenceDistances
from meshspiral.data.shapes import SPLITS, DataError, Shape, ShapeSet
from meshspiral.data.tensors import draw
from meshspiral.geometry.digest import derived_seed, digest
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.neighbourhoods.base import Batch


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
            meshes do not fit into `KEPT` bytes of memory, else none. With `fresh`, so many that
            each process that trains keeps one core for itself, and at least one.
        fresh: Train each epoch on other versions of the shapes. Readers make them ahead of the
            steps of the epoch, and they are cached.

    Raises:
        DataError: `fresh`, of shapes that have no other versions.
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
        fresh: bool = False,
    ):
        super().__init__()
        if fresh and not shapes.fresh:
            raise DataError(
                "data.fresh needs shapes that can be made anew: data=anny, data/remesh= or "
                "data/damage="
            )
        self.fresh = fresh
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
        if wanted:
            self.prepare(wanted)

    def prepare(self, wanted: list[str] | tuple[str, ...] = SPLITS, visit: bool = False) -> None:
        """Compute what is not cached for these splits.

        Args:
            wanted: The splits.
            visit: See `Recipe.prepare_all`.

        Raises:
            DataError: A split has no mesh, or a shape is wrong.
            MeshError: A mesh cannot be read or described.
            CacheError: The cache cannot be written.
        """
        for split in wanted:
            if not self.shapes.names[split]:
                raise DataError(f"the split {split} must have at least 1 mesh, got 0")
        names = [name for split in wanted for name in self.shapes.names[split]]
        prepared = self.recipe.prepare_all(names, self.workers, visit)
        repeated = Counter(each.table for each in prepared)
        tables = {key: None for key, count in repeated.items() if count > 1}
        rest = iter(prepared)
        for split in wanted:
            of_split = list(islice(rest, len(self.shapes.names[split])))
            self.datasets[split] = MeshDataset(self.recipe, of_split, tables)

    def train_dataloader(self) -> DataLoader:
        skip, self._skip = self._skip, 0
        rank, world = self._rank_and_world()
        size = len(self.datasets["train"])
        sampler = EpochSampler(size, self.seed, skip, rank, world, self.fresh)
        return self._loader("train", sampler)

    def val_dataloader(self) -> DataLoader:
        return self._in_order("val")

    def test_dataloader(self) -> DataLoader:
        return self._in_order("test")

    def _in_order(self, split: str) -> DataLoader:
        """Every mesh once, divided among the processes."""
        rank, world = self._rank_and_world()
        return self._loader(split, range(rank, len(self.datasets[split]), world))

    def check_sizes(self, processes: int) -> None:
        """Refuse splits that leave a process without a mesh.

        Raises:
            DataError: Validation or test has fewer meshes than there are processes.
        """
        for split in ("val", "test"):
            if (size := len(self.datasets[split])) < processes:
                raise DataError(
                    f"the split {split} must have a mesh for each of {processes} processes, "
                    f"got {size}"
                )

    def _loader(self, split: str, sampler: Iterable[int]) -> DataLoader:
        dataset = self.datasets[split]
        readers = self.readers
        if readers is None and self.fresh and split == "train":
            processes = self.trainer.num_devices if self.trainer is not None else 1
            readers = max(1, cpu_count() // processes - 1)
        elif readers is None:
            readers = int(item_bytes(dataset[0]) * dataset.sizes.sum() / dataset.sizes[0] > KEPT)
        ahead = {
            "multiprocessing_context": "spawn",  # forks could hang in libraries that have threads
            "persistent_workers": True,
            "worker_init_fn": ignore_signals,
        }
        options = ahead if readers else {}
        loader = DataLoader(
            dataset, batch_size=None, sampler=sampler, num_workers=readers, **options
        )
        if readers:
            atexit.register(end_readers, weakref.ref(loader))
        return loader

    def _rank_and_world(self) -> tuple[int, int]:
        trainer = self.trainer
        return (trainer.global_rank, trainer.world_size) if trainer is not None else (0, 1)

    def on_after_batch_transfer(self, batch: Batch, dataloader_idx: int) -> Batch:
        training = self.trainer.training
        when = f"epoch {self.trainer.current_epoch}" if training else "evaluation"
        if training:
            purpose = (self.seed, "features", when, batch["index"])
            generator = torch.Generator(batch["features"].device)
            generator.manual_seed(derived_seed(*purpose))
            batch["features"] = self.features.drawn(batch["features"], generator)
        return draw(self.neighbourhood, batch, self.seed, "spirals", when, training=training)

    def state_dict(self) -> dict[str, Any]:
        progress = self.trainer.fit_loop.epoch_loop.batch_progress.current
        done = progress.completed
        skip = 0 if done >= self.trainer.num_training_batches else done
        return {"skip": skip, "train": digest(*self.shapes.names["train"])}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._skip = state["skip"]

    def check_checkpoint(self, saved: dict[str, Any]) -> None:
        """Raise DataError if the training meshes are not those of the run of a checkpoint."""
        names = self.shapes.names["train"]
        known = saved.get(type(self).__qualname__, {}).get("train")  # earlier versions: unknown
        if known not in (None, digest(*names)):
            raise DataError(
                f"the {len(names)} training meshes are not those of the run that is resumed; to "
                "train on others, start a run with init=<run_folder>"
            )
