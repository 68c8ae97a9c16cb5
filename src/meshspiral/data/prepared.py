"""What training reads of a shape: prepared once, kept in the cache, and read when it is served."""

from __future__ import annotations

import contextlib
import inspect
import json
import logging
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from meshspiral.data import mesh_files, preprocessing
from meshspiral.data.cache import Arrays, Cache, code_version
from meshspiral.data.descriptors import Features
from meshspiral.data.pool import run_all
from meshspiral.data.preprocessing import (
    descriptor_task,
    frame_task,
    load_task,
    neighbourhood_task,
    sources,
)
from meshspiral.data.shapes import DataError, Shape, ShapeSet
from meshspiral.data.tensors import described_tensors
from meshspiral.geometry import mesh as meshes
from meshspiral.geometry import shot
from meshspiral.geometry.digest import derived_seed, digest
from meshspiral.geometry.mesh import Mesh
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.neighbourhoods.base import Batch

log = logging.getLogger(__name__)


class Prepared(NamedTuple):
    """Where the cache holds the results of one shape: kinds and keys.

    Attributes:
        name: Name of the shape.
        vertices: Number of its vertices.
        shape: Its mesh and labels.
        described: Its descriptors.
        table: Its neighbourhoods.
        frames: The local frames of its neighbourhoods; None for none.
        undefined: For each descriptor the number of vertices where it is undefined.
    """

    name: str
    vertices: int
    shape: str
    described: list[str]
    table: str
    frames: str | None
    undefined: list[int]


@dataclass(frozen=True, eq=False)
class Recipe:
    """How batches are made of a data set. Picklable: worker processes prepare shapes by it.

    Args:
        shapes: The data set.
        features: The descriptors.
        neighbourhood: What the network reads around a vertex.
        cache: Where results are kept.
        shuffle: Seed by which the vertices of every mesh are renumbered; None: as they are.
        half: Keep descriptors as float16.
    """

    shapes: ShapeSet
    features: Features
    neighbourhood: Neighbourhood
    cache: Cache
    shuffle: int | None = None
    half: bool = False

    def shape(self, name: str) -> Shape:
        """A shape as it is served: renumbered if `shuffle` is not None."""
        shape = self.shapes.load(name)
        if self.shuffle is None:
            return shape
        rng = np.random.default_rng(derived_seed(self.shuffle, "shuffle", name))
        return shape.renumbered(rng.permutation(len(shape.labels)))

    def prepare_all(
        self, names: Sequence[str], workers: int | None, visit: bool = False
    ) -> list[Prepared]:
        """Compute what the cache lacks for these shapes, in worker processes if that is faster.

        If all of it was computed before, and no file of the data set has changed since, no mesh is
        read.

        Args:
            names: The shapes.
            workers: Number of processes; None for one per core.
            visit: Go through all meshes nevertheless, so that all results that they need count as
                read now, see `Cache.prune`.

        Raises:
            DataError, MeshError: A shape is unusable, or a worker process was killed.
            CacheError: The cache cannot be written.
        """
        manifest = self._manifest(names)
        found = read_manifest(manifest, names) if manifest and not visit else None
        if found is None:
            noun = f"Descriptors and {self.neighbourhood.noun}"
            found = run_all(self.prepare, names, workers, noun)
            if manifest:
                self.cache.write(manifest, json.dumps([each._asdict() for each in found]))
        for prepared in found:
            for descriptor, undefined in zip(
                self.features.descriptors, prepared.undefined, strict=True
            ):
                if undefined:
                    log.warning(
                        "%s: %s is undefined at %d of %d vertices; using zeros",
                        prepared.name,
                        descriptor.name.upper(),
                        undefined,
                        prepared.vertices,
                    )
        return found

    def prepare(self, name: str, check: bool = False) -> Prepared:
        """Compute what the cache lacks for one shape. Raises what `prepare_all` does.

        Args:
            name: The shape.
            check: Whether what the cache has is read whole, and computed again if it is damaged.
        """
        shape = self.shape(name)
        mesh, least = shape.mesh, self.neighbourhood.least_vertices
        if least > len(mesh.vertices):
            raise DataError(
                f"{name}: {self.neighbourhood.noun} must have at most the {len(mesh.vertices):,} "
                f"vertices of the mesh, got {least:,}"
            )
        described = [descriptor_task(mesh, each, self.half) for each in self.features.descriptors]
        table = neighbourhood_task(mesh, self.neighbourhood)
        frame = self.neighbourhood.frame and frame_task(mesh, self.neighbourhood.frame)
        results = [load_task(t, self.cache, check) for t in described]
        for task in filter(None, (frame, table)):
            load_task(task, self.cache, check)
        arrays = {"vertices": mesh.vertices, "faces": mesh.faces, "labels": shape.labels}
        arrays |= shape.points._asdict() if shape.points else {}
        if mesh.complete_area is not None:
            arrays["complete_area"] = np.array(mesh.complete_area)
        key = digest(*(array for _, array in sorted(arrays.items())))
        self.cache.get("shapes", key, lambda: arrays, check)
        return Prepared(
            name,
            len(mesh.vertices),
            key,
            [task.key for task in described],
            table.key,
            frame and frame.key,
            [int(result["undefined"]) for result in results],
        )

    def read(self, prepared: Prepared, tables: dict[str, Arrays | None]) -> Batch:
        """The tensors of a shape, see `MeshDataset`, mapped from the cache.

        Args:
            prepared: From `prepare_all`.
            tables: Where tables of several meshes are found, or kept, by key.
        """
        found = self._load(prepared)
        if found is None:  # removed from the cache meanwhile, or damaged
            found = self._load(self.prepare(prepared.name, check=True))
        described, shape, arrays, frames = found
        if prepared.table in tables:
            arrays = tables[prepared.table] = tables[prepared.table] or arrays
        complete_area = float(shape["complete_area"]) if "complete_area" in shape else None
        mesh = Mesh(shape["vertices"], shape["faces"], prepared.name, complete_area)
        item = described_tensors(described, mesh, self.features)
        extra = [] if frames is None else [frames["frames"]]
        item |= self.neighbourhood.tensors(arrays, mesh, *extra)
        for name in ("labels", "corners", "weights"):
            if name in shape:
                item[name] = torch.from_numpy(shape[name])
        return item

    def _load(
        self, prepared: Prepared, check: bool = False
    ) -> tuple[list[Arrays], Arrays, Arrays, Arrays | None] | None:
        kinds = [descriptor.name for descriptor in self.features.descriptors]
        wanted = [*zip(kinds, prepared.described, strict=True), ("shapes", prepared.shape)]
        wanted.append((self.neighbourhood.name, prepared.table))
        if prepared.frames:
            wanted.append(("frames", prepared.frames))
        found = [self.cache.load(kind, key, check) for kind, key in wanted]
        if any(arrays is None for arrays in found):
            return None
        described, (shape, table, *frames) = found[: len(kinds)], found[len(kinds) :]
        return described, shape, table, frames[0] if frames else None

    def _manifest(self, names: Sequence[str]) -> Path | None:
        """The file that says where the results of these shapes are; None if that cannot be told
        without reading the meshes."""
        stamps = [self.shapes.stamp(name) for name in names]
        if None in stamps:
            return None
        template = self.shapes.template
        parts = (*self.features.descriptors, self.neighbourhood)
        modules = [module for part in parts for module in (*part.modules, *sources(part))]
        modules += [mesh_files, meshes, preprocessing, shot]
        shapes: ShapeSet | None = self.shapes
        while shapes:  # the data set, and those that it changes
            classes = [cls for cls in type(shapes).__mro__ if issubclass(cls, ShapeSet)]
            modules += map(inspect.getmodule, classes)
            shapes = shapes.base
        key = digest(
            template.vertices,
            template.faces,
            *(text for each in zip(names, stamps, strict=True) for text in each),
            *(f"{part.name} {sorted(part.settings or {})}" for part in parts),
            code_version(*modules, sys.modules[__name__]),
            self.shuffle,
            self.half,
        )
        return self.cache.root / "manifests" / f"{key}.json"


def read_manifest(path: Path, names: Sequence[str]) -> list[Prepared] | None:
    """The content of a manifest of these shapes; None if it is missing or damaged."""
    try:
        found = [Prepared(**fields) for fields in json.loads(path.read_text())]
    except (OSError, ValueError, TypeError):
        return None
    if [each.name for each in found] != list(names):
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # it was read now
    return found
