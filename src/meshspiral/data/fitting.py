"""Settings of descriptors that are fitted to the training shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from meshspiral.data.cache import Cache
from meshspiral.data.descriptors import Descriptor, Features
from meshspiral.data.pool import run_all
from meshspiral.data.preprocessing import load_task, measure_task
from meshspiral.data.shapes import ShapeSet
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
    return load_task(measure_task(shapes.load(name).mesh, descriptor), cache)["measured"]
