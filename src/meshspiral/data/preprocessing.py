"""From a mesh to the arrays that a network reads, each computed once and cached."""

from __future__ import annotations

import inspect
import os
import random
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from types import ModuleType

import numpy as np
from joblib import cpu_count
from tqdm import tqdm

from meshspiral.data.cache import Arrays, Cache, code_version
from meshspiral.data.descriptors import Descriptor
from meshspiral.data.pool import run_in_pool
from meshspiral.geometry import mesh as meshes
from meshspiral.geometry import shot
from meshspiral.geometry.digest import digest
from meshspiral.geometry.mesh import Mesh, MeshError
from meshspiral.geometry.shot import Frame
from meshspiral.neighbourhoods import Neighbourhood

POOL_START = 6.0  # seconds that starting the worker processes takes


@dataclass(frozen=True, eq=False)
class Task:
    """One result: `compute(*arguments)`, cached as `kind` under `key`.

    An argument that is a task itself is replaced by its result, the first array of it.
    """

    kind: str
    key: str
    compute: Callable[..., Arrays]
    arguments: tuple


def frame_task(mesh: Mesh, frame: Frame) -> Task:
    """The local frames of a mesh: `frames` float32 [V, 3, 3], see `local_frames`."""
    version = code_version(meshes, shot, sys.modules[__name__])
    key = digest(mesh.vertices, mesh.faces, *frame, version)
    return Task("frames", key, _frames, (mesh, frame))


def descriptor_task(mesh: Mesh, descriptor: Descriptor) -> Task:
    """A descriptor: `features` float32 [V, C], zeros where it is undefined, and `undefined`, the
    number of such vertices."""
    key = digest(
        repr(sorted(descriptor.settings.model_dump().items())),
        mesh.vertices,
        mesh.faces,
        code_version(*descriptor.modules, *_sources(descriptor), meshes, sys.modules[__name__]),
    )
    return Task(descriptor.name, key, partial(_described, descriptor), _inputs(descriptor, mesh))


def neighbourhood_task(mesh: Mesh, neighbourhood: Neighbourhood) -> Task:
    """The arrays of a neighbourhood, see its `compute`."""
    version = code_version(*neighbourhood.modules, *_sources(neighbourhood))
    settings = sorted(neighbourhood.settings.model_dump().items())
    key = digest(repr(settings), *neighbourhood.mesh_key(mesh), version)
    inputs = _inputs(neighbourhood, mesh)
    return Task(neighbourhood.name, key, neighbourhood.compute, inputs)


def _sources(described: Descriptor | Neighbourhood) -> list[ModuleType]:
    """The modules of an object's class and of those that it derives from, without the base."""
    classes = [
        cls for cls in type(described).__mro__ if issubclass(cls, Descriptor | Neighbourhood)
    ]
    return [inspect.getmodule(cls) for cls in classes[:-1]]


def _inputs(described: Descriptor | Neighbourhood, mesh: Mesh) -> tuple:
    """What its `compute` takes: the mesh, and frames if it needs them."""
    frame = described.frame
    return (mesh,) if frame is None else (mesh, frame_task(mesh, frame))


def _frames(mesh: Mesh, frame: Frame) -> Arrays:
    _check_area(mesh)
    masses = mesh.vertex_areas if frame.by_area else None
    radius = frame.support * np.sqrt(mesh.area)
    return {"frames": shot.local_frames(mesh.centred, radius, masses)}


def _described(descriptor: Descriptor, mesh: Mesh, *frames: np.ndarray) -> Arrays:
    _check_area(mesh)
    features = descriptor.compute(mesh, *frames)
    undefined = np.isnan(features).any(axis=1)
    features[undefined] = 0.0
    return {"features": features, "undefined": np.array(undefined.sum())}


def _check_area(mesh: Mesh) -> None:
    if mesh.area == 0:
        raise MeshError(f"{mesh.name}: surface area must be above 0 to scale descriptors, got 0")


def run_tasks(tasks: Iterable[Task], cache: Cache, workers: int | None, description: str) -> None:
    """Compute and cache what the cache lacks, with a progress bar.

    The order is random and differs between processes, so that jobs of a sweep that start together
    share the work. Worker processes are started only if the remaining work would take longer than
    starting them.

    Args:
        tasks: Several tasks may have one key.
        cache: Where results go.
        workers: Number of processes; None for one per core.
        description: Label of the progress bar.

    Raises:
        DataError: A worker process was killed.
        CacheError: The cache cannot be written.
        MeshError: A mesh cannot be described.
    """
    missing = {task.key: task for task in tasks if not cache.has(task.kind, task.key)}
    queue = list(missing.values())
    random.Random(os.getpid()).shuffle(queue)
    workers = min(workers or cpu_count(), len(queue))
    with tqdm(total=len(queue), desc=description, delay=1.0) as progress:
        started = None
        for done, task in enumerate(queue):
            if workers > 1 and done > 1:
                remaining = (time.perf_counter() - started) / (done - 1) * (len(queue) - done)
                if remaining > POOL_START:
                    jobs = ((task, cache) for task in queue[done:])
                    for _ in run_in_pool(_run, jobs, workers, "data.workers=1"):
                        progress.update()
                    return
            _run(task, cache)
            progress.update()
            started = started or time.perf_counter()  # after the first task, which compiles


def _run(task: Task, cache: Cache) -> None:
    if not cache.has(task.kind, task.key):  # another process may have computed it meanwhile
        cache.save(task.kind, task.key, compute_task(task, cache))


def load_task(task: Task, cache: Cache) -> Arrays:
    """The result of a task: from the cache, or computed if it is missing or damaged there."""
    return cache.get(task.kind, task.key, lambda: compute_task(task, cache))


def compute_task(task: Task, cache: Cache | None = None) -> Arrays:
    """Compute a task, and those among its arguments; the latter through the cache, if given."""
    arguments = []
    for argument in task.arguments:
        if isinstance(argument, Task):
            load = compute_task if cache is None else load_task
            argument = next(iter(load(argument, cache).values()))
        arguments.append(argument)
    return task.compute(*arguments)
