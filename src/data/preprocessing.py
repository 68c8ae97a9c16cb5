"""From a mesh to the arrays that a network reads, each computed once and kept."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from joblib import Parallel, cpu_count, delayed
from tqdm import tqdm

from src.data.store import Arrays, Store, code_version, digest
from src.geometry import connectivity, mesh, shot, spirals
from src.geometry.mesh import Mesh, MeshError


@dataclass(frozen=True)
class Recipe:
    """What is computed of each mesh.

    shot_radius: over the square root of the mesh's surface area. shot_bins: of the cosine.
    seq_len or rings: one of them, see `spiral_table`; the other None.
    """

    shot_radius: float
    shot_bins: int
    seq_len: int | None
    rings: int | None = None


@dataclass(frozen=True, eq=False)
class Task:
    """One result: kept under `key`, computed by `compute(*arguments)`."""

    kind: str
    key: str
    compute: Callable[..., Arrays]
    arguments: tuple


def descriptor_task(mesh_: Mesh, recipe: Recipe) -> Task:
    """SHOT: `features` float32 [V, 32 (bins + 1)], zeros where undefined; `undefined`: how many."""
    version = code_version(mesh, shot, sys.modules[__name__])
    key = digest(mesh_.vertices, mesh_.faces, recipe.shot_radius, recipe.shot_bins, version)
    return Task("shot", key, _descriptors, (mesh_, recipe.shot_radius, recipe.shot_bins))


def spiral_task(mesh_: Mesh, recipe: Recipe) -> Task:
    """`sequences` and `first` of `SpiralTable`, kept by one-rings: one table serves all poses."""
    version = code_version(connectivity, spirals, sys.modules[__name__])
    rings = connectivity.one_rings(mesh_)
    key = digest(*rings, recipe.seq_len, recipe.rings, version)
    return Task("spirals", key, _spirals, (mesh_, recipe.seq_len, recipe.rings))


def _descriptors(mesh_: Mesh, radius: float, bins: int) -> Arrays:
    if mesh_.area == 0:
        raise MeshError(f"{mesh_.name}: no surface area, so there is no scale to describe it at")
    length = radius * np.sqrt(mesh_.area)
    # far from the origin float32, in which SHOT is defined, would have no digits left
    centred = mesh_.vertices - mesh_.vertices.mean(axis=0)
    features = shot.shot_descriptors(centred, mesh_.vertex_normals, length, bins)
    undefined = np.isnan(features).any(axis=1)
    features[undefined] = 0.0
    return {"features": features, "undefined": np.array(undefined.sum())}


def _spirals(mesh_: Mesh, seq_len: int | None, rings: int | None) -> Arrays:
    table = spirals.spiral_table(mesh_, seq_len, rings=rings)
    return {"sequences": table.sequences, "first": table.first}


def run_tasks(tasks: Iterable[Task], store: Store, workers: int | None, description: str) -> None:
    """Compute and keep what the store lacks, with a progress bar.

    workers: processes; None for one per core. Other processes are started only when what remains
    would keep this one busy for longer than their start takes.
    """
    missing = {task.key: task for task in tasks if not store.has(task.kind, task.key)}
    queue = list(missing.values())
    workers = min(workers or cpu_count(), len(queue))
    progress = tqdm(total=len(queue), desc=description, unit="mesh", delay=1.0)
    with progress:
        started = None
        for done, task in enumerate(queue):
            if workers > 1 and done > 1:
                remaining = (time.perf_counter() - started) / (done - 1) * (len(queue) - done)
                if remaining > 6.0:
                    _run_in_pool(queue[done:], store, workers, progress)
                    return
            _run(task, store)
            progress.update()
            started = started or time.perf_counter()  # after the first task: that one compiles


def _run(task: Task, store: Store) -> None:
    store.save(task.kind, task.key, task.compute(*task.arguments))


def _run_in_pool(tasks: list[Task], store: Store, workers: int, progress: tqdm) -> None:
    # idle workers would stay for five minutes, with their memory
    pool = Parallel(n_jobs=workers, return_as="generator_unordered", idle_worker_timeout=2)
    for _ in pool(delayed(_run)(task, store) for task in tasks):
        progress.update()


def load_task(task: Task, store: Store) -> Arrays:
    """The result of a task, from the store if it is there and sound, else computed again."""
    return store.get(task.kind, task.key, lambda: task.compute(*task.arguments))
