"""Data sets and data modules as a config describes them."""

from __future__ import annotations

from itertools import chain
from typing import Any

import meshspiral.data.datasets  # noqa: F401  registers the data sets
from meshspiral.data.cache import Cache
from meshspiral.data.damaged import Damaged
from meshspiral.data.datamodule import CorrespondenceData
from meshspiral.data.descriptors import Features
from meshspiral.data.fitting import fitted_features
from meshspiral.data.remeshed import Remeshed
from meshspiral.data.settings import DataSettings
from meshspiral.data.shapes import DataError, ShapeSet
from meshspiral.neighbourhoods import Neighbourhood


def open_shapes(settings: DataSettings) -> ShapeSet:
    """The data set of a config.

    Raises:
        DataError: The data set is missing or wrong.
        MeshError: A mesh cannot be used.
    """
    shapes = ShapeSet.registered[settings.name](**settings.own())
    for name in chain(*shapes.names.values()):
        if "@" in name or "~" in name:  # these mark epochs and copies
            raise DataError(f"the name of a shape must be without '@' and '~', got {name!r}")
    if settings.remesh is not None:
        cache = Cache(settings.cache_dir)
        shapes = Remeshed(shapes, cache, settings.workers, **settings.remesh.model_dump())
    if settings.damage is not None:
        shapes = Damaged(shapes, settings.damage)
    return shapes


def open_data(config: Any) -> CorrespondenceData:
    """The data module of a whole config, a `TrainConfig`.

    Settings of descriptors that are to be fitted are fitted to its training shapes.

    Raises:
        DataError: The data set is missing or wrong.
        MeshError: A mesh cannot be used.
        CacheError: The cache cannot be written.
    """
    data = config.data
    shapes, cache = open_shapes(data), Cache(data.cache_dir)
    return CorrespondenceData(
        shapes,
        fitted_features(Features.of(data), shapes, cache, data.workers),
        Neighbourhood.of(config.neighbourhood),
        cache,
        config.seed,
        data.shuffle_vertices,
        data.workers,
        data.half,
        data.readers,
        data.fresh,
    )
