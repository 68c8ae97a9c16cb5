"""Settings of descriptors that are fitted to the training shapes."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from meshspiral.data.cache import Cache, code_version
from meshspiral.data.descriptors import Descriptor, Features
from meshspiral.data.pool import run_all
from meshspiral.data.preprocessing import Task, load_task, sources
from meshspiral.data.shapes import ShapeSet
from meshspiral.geometry import mesh as meshes
from meshspiral.geometry.digest import digest
from meshspiral.geometry.mesh import Mesh


def fitted_features(
    features: Features, shapes: ShapeSet, cache: Cache, workers: int | None
) -> Features:
    """The descriptors with their settings fitted to the training shapes of a data set, and to no
    other.

    Args:
        features: Some may be unfitted.
        shapes: The data set.
        cache: Where measures of shapes are kept.
        workers: Number of processes; None for one per core.

    Raises:
        DataError, MeshError: A training shape cannot be used.
        CacheError: The cache cannot be written.
    """
    found: list[Descriptor] = []
    for descriptor in features.descriptors:
        if descriptor.unfitted:
            names = shapes.names["train"]
            measure = partial(measure_shape, descriptor, shapes, cache)
            label = f"Fitting {descriptor.name.upper()}"
            descriptor = descriptor.with_fitted(run_all(measure, names, workers, label))
        found.append(descriptor)
    return replace(features, descriptors=tuple(found))


def fitted_to(features: Features, meshes: Sequence[Mesh]) -> Features:
    """The descriptors with their settings fitted to some meshes."""
    found = (
        descriptor.with_fitted([descriptor.measure(mesh) for mesh in meshes])
        if descriptor.unfitted
        else descriptor
        for descriptor in features.descriptors
    )
    return replace(features, descriptors=tuple(found))


def measure_shape(descriptor: Descriptor, shapes: ShapeSet, cache: Cache, name: str) -> np.ndarray:
    """What an unfitted descriptor measures of a shape, through the cache."""
    mesh = shapes.load(name).mesh
    key = digest(
        repr(sorted(descriptor.settings.model_dump().items())),
        mesh.vertices,
        mesh.faces,
        mesh.whole,
        code_version(*descriptor.modules, *sources(descriptor), meshes, sys.modules[__name__]),
    )
    task = Task(f"{descriptor.name}-fit", key, partial(_measured, descriptor), (mesh,))
    return load_task(task, cache)["measured"]


def _measured(descriptor: Descriptor, mesh: Mesh) -> dict[str, np.ndarray]:
    return {"measured": descriptor.measure(mesh)}
