"""Seconds of preprocessing: of one mesh on one core, and of a data set on all cores."""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Callable
from functools import partial

from joblib import cpu_count

from meshspiral.benchmarking.inputs import first_body
from meshspiral.benchmarking.measure import Row, medians
from meshspiral.data.cache import Cache
from meshspiral.data.descriptors import Descriptor, Features
from meshspiral.data.fitting import fitted_to
from meshspiral.data.preprocessing import (
    Task,
    compute_task,
    descriptor_task,
    frame_task,
    neighbourhood_task,
    run_tasks,
)
from meshspiral.data.sources import open_shapes
from meshspiral.experiment.schema import BenchmarkConfig, TrainConfig
from meshspiral.geometry.mesh import Mesh
from meshspiral.neighbourhoods import Neighbourhood

log = logging.getLogger(__name__)
LONGEST = 600.0  # seconds for all bodies


def preprocessing_rows(config: BenchmarkConfig, networks: list[TrainConfig]) -> list[Row]:
    """A row for each descriptor, each neighbourhood of the networks, the local frames that these
    need, and everything.

    The last row is everything for all bodies, with all cores, from an empty cache. It is omitted if
    it would take more than `LONGEST` seconds.
    """
    data, makers = networks[0].data, dict[str, Callable[[Mesh], Task]]()
    mesh = first_body(networks[0]).mesh
    for descriptor in fitted_to(Features.of(data), [mesh]).descriptors:
        makers |= _frame_maker(descriptor)
        makers[descriptor.name] = partial(descriptor_task, descriptor=descriptor)
    for network in networks:
        around = Neighbourhood.of(network.neighbourhood)
        makers |= _frame_maker(around)
        makers[around.title] = partial(neighbourhood_task, neighbourhood=around)
    tasks = {name: make(mesh) for name, make in makers.items()}
    with tempfile.TemporaryDirectory() as folder:
        cache = Cache(folder)  # of what is in other rows
        actions = {name: partial(compute_task, task, cache) for name, task in tasks.items()}
        seconds = medians(actions, config.repeats)
    rows: list[Row] = [{"what": name, "meshes": 1, "seconds": s} for name, s in seconds.items()]
    shapes = open_shapes(data)
    names = [name for split in shapes.names.values() for name in split]
    expected = sum(seconds.values()) * len(names) / cpu_count()
    if expected > LONGEST:
        minutes = expected / 60
        log.warning("all %d bodies: omitted, about %.0f minutes", len(names), minutes)
        return rows
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        meshes = [shapes.load(name).mesh for name in names]
        every_task = (make(mesh) for mesh in meshes for make in makers.values())
        run_tasks(every_task, Cache(folder), None, "Bodies")
        everything = time.perf_counter() - began
    return [*rows, {"what": "everything", "meshes": len(names), "seconds": everything}]


def _frame_maker(user: Descriptor | Neighbourhood) -> dict[str, Callable[[Mesh], Task]]:
    """The local frames that a descriptor or a neighbourhood needs, by name; empty for none."""
    if (frame := user.frame) is None:
        return {}
    weights = "by area" if frame.by_area else "counted"
    return {f"frames of support {frame.support}, {weights}": partial(frame_task, frame=frame)}
