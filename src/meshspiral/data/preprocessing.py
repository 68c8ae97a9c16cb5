"""From a mesh to the arrays that a network reads, each computed once and cached."""

from __future__ import annotations

import inspect
import os
import random
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from joblib import cpu_count
from tqdm import tqdm

from meshspiral.data.cache import Arrays, Cache, code_version
from meshspiral.data.pool import run_in_pool
from meshspiral.data.settings import ShotSettings
from meshspiral.geometry import angles, mesh, shot
from meshspiral.geometry.digest import digest
from meshspiral.geometry.mesh import Mesh, MeshError
from meshspiral.neighbourhoods import Neighbourhood

POOL_START = 6.0  # seconds that starting the worker processes takes


@dataclass(frozen=True, eq=False)
class Task:
    """One result: `compute(*arguments)`, cached as `kind` under `key`."""

    kind: str
    key: str
    compute: Callable[..., Arrays]
    arguments: tuple


def descriptor_task(mesh_: Mesh, settings: ShotSettings) -> Task:
    """SHOT descriptors: `features` float32 [V, 32 (bins + 1)], zeros where SHOT is undefined, and
    `undefined`, the number of such vertices."""
    version = code_version(angles, mesh, shot, sys.modules[__name__])
    key = digest(mesh_.vertices, mesh_.faces, settings.radius, settings.bins, version)
    return Task("shot", key, _descriptors, (mesh_, settings.radius, settings.bins))


def neighbourhood_task(mesh_: Mesh, neighbourhood: Neighbourhood) -> Task:
    """The arrays of a neighbourhood, see its `compute`."""
    classes = [cls for cls in type(neighbourhood).__mro__ if issubclass(cls, Neighbourhood)]
    sources = [inspect.getmodule(cls) for cls in classes if cls is not Neighbourhood]
    version = code_version(*neighbourhood.modules, *sources)
    settings = sorted(neighbourhood.settings.model_dump().items())
    key = digest(repr(settings), *neighbourhood.mesh_key(mesh_), version)
    return Task(neighbourhood.name, key, neighbourhood.compute, (mesh_,))


def _descriptors(mesh_: Mesh, radius: float, bins: int) -> Arrays:
    if mesh_.area == 0:
        raise MeshError(f"{mesh_.name}: surface area must be above 0 to scale descriptors, got 0")
    length = radius * np.sqrt(mesh_.area)
    # SHOT is defined in float32, which has no digits left far from the origin
    centred = mesh_.vertices - mesh_.vertices.mean(axis=0)
    features = shot.shot_descriptors(centred, mesh_.vertex_normals, length, bins)
    undefined = np.isnan(features).any(axis=1)
    features[undefined] = 0.0
    return {"features": features, "undefined": np.array(undefined.sum())}


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
        cache.save(task.kind, task.key, task.compute(*task.arguments))


def load_task(task: Task, cache: Cache) -> Arrays:
    """The result of a task: from the cache, or computed if it is missing or damaged there."""
    return cache.get(task.kind, task.key, lambda: task.compute(*task.arguments))
