"""From a mesh to the arrays that a network reads, each computed once and kept."""

from __future__ import annotations

import os
import random
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import astuple, dataclass

import numpy as np
from joblib import Parallel, cpu_count, delayed
from joblib.externals.loky.process_executor import TerminatedWorkerError
from scipy.sparse import csr_array
from tqdm import tqdm

from meshspiral.data.cache import Arrays, Store, code_version, digest
from meshspiral.data.shapes import DataError
from meshspiral.geometry import (
    angles,
    connectivity,
    geodesics,
    mesh,
    patches,
    shot,
    spirals,
    windows,
)
from meshspiral.geometry.mesh import Mesh, MeshError


@dataclass(frozen=True)
class PatchRecipe:
    """The polar grid around every vertex, its first ray in a direction drawn at random.

    radius: over the mesh's geodesic diameter. weights: how a sample is blended from vertices; by
    "interpolation" in the triangle it lies in, or by the "gaussian" windows of the original.
    """

    radius: float
    rings: int = 5
    rays: int = 16
    weights: str = "interpolation"


@dataclass(frozen=True)
class Recipe:
    """What is computed of each mesh: its descriptors, and either spirals or patches.

    shot_radius: over the square root of the mesh's surface area. shot_bins: of the cosine.
    seq_len or rings: of spirals, one of them, see `spiral_table`. patch: of patches.
    """

    shot_radius: float
    shot_bins: int
    seq_len: int | None = None
    rings: int | None = None
    patch: PatchRecipe | None = None


@dataclass(frozen=True, eq=False)
class Task:
    """One result: kept under `key`, computed by `compute(*arguments)`."""

    kind: str
    key: str
    compute: Callable[..., Arrays]
    arguments: tuple


def descriptor_task(mesh_: Mesh, recipe: Recipe) -> Task:
    """SHOT: `features` float32 [V, 32 (bins + 1)], zeros where undefined; `undefined`: how many."""
    version = code_version(angles, mesh, shot, sys.modules[__name__])
    key = digest(mesh_.vertices, mesh_.faces, recipe.shot_radius, recipe.shot_bins, version)
    return Task("shot", key, _descriptors, (mesh_, recipe.shot_radius, recipe.shot_bins))


def spiral_task(mesh_: Mesh, recipe: Recipe) -> Task:
    """`sequences` and `first` of `SpiralTable`, kept by one-rings: one table serves all poses."""
    version = code_version(connectivity, spirals, sys.modules[__name__])
    rings = connectivity.one_rings(mesh_)
    key = digest(*rings, recipe.seq_len, recipe.rings, version)
    return Task("spirals", key, _spirals, (mesh_, recipe.seq_len, recipe.rings))


def patch_task(mesh_: Mesh, recipe: Recipe) -> Task:
    """`indices` int32 [E], `weights` float32 [E] and `first` int32 [S+1]: sample s is the sum over
    k in first[s]:first[s+1] of weights[k] f[indices[k]]; samples by vertex, then ray, then ring."""
    version = code_version(connectivity, geodesics, patches, windows, sys.modules[__name__])
    key = digest(mesh_.vertices, mesh_.faces, *astuple(recipe.patch), version)
    return Task("patches", key, _patches, (mesh_, recipe.patch))


def neighbourhood_task(mesh_: Mesh, recipe: Recipe) -> Task:
    """Spirals or patches, whichever the recipe asks for."""
    return (patch_task if recipe.patch else spiral_task)(mesh_, recipe)


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


def _patches(mesh_: Mesh, patch: PatchRecipe) -> Arrays:
    radius = patch.radius * geodesics.diameter(mesh_)
    grid = (radius, patch.rings, patch.rays, first_directions(mesh_))
    if patch.weights == "gaussian":
        indices, weights, first = windows.gaussian_windows(mesh_, *grid)
    else:
        table = patches.geodesic_patches(mesh_, *grid)
        whole = table.whole.ravel()
        indices, weights = (array.reshape(-1, 3)[whole].ravel() for array in table)
        first = 3 * np.concatenate([[0], np.cumsum(whole)])
    samples = csr_array((weights, indices, first), shape=(len(first) - 1, len(mesh_.vertices)))
    rows = np.arange(len(first) - 1).reshape(-1, patch.rings, patch.rays)
    by_ray = samples[rows.transpose(0, 2, 1).ravel()]
    return {
        "indices": by_ray.indices.astype(np.int32),
        "weights": by_ray.data,
        "first": by_ray.indptr.astype(np.int32),
    }


def first_directions(mesh_: Mesh) -> np.ndarray:
    """float64 [V]: where the grid of each vertex begins, at random, and always alike for one mesh.

    Else the grids of registered meshes would all begin at the same edges, and a network would know
    its vertices by them.
    """
    rng = np.random.default_rng(int(digest(mesh_.vertices, mesh_.faces)[:15], 16))
    return rng.uniform(0, 2 * np.pi, len(mesh_.vertices))


def by_rows_and_columns(arrays: Arrays, vertices: int) -> Arrays:
    """The samples of `patch_task` for a mesh of so many vertices, as a network reads them: see
    `meshspiral.nn.geodesic.Resampling`."""
    rows = csr_array(
        (arrays["weights"], arrays["indices"], arrays["first"]),
        shape=(len(arrays["first"]) - 1, vertices),
    )
    columns = rows.tocsc()
    return {
        "vertices": rows.indices,
        "weights": rows.data,
        "first": rows.indptr,
        "samples": columns.indices,
        "sample_weights": columns.data,
        "sample_first": columns.indptr,
    }


def run_tasks(tasks: Iterable[Task], store: Store, workers: int | None, description: str) -> None:
    """Compute and keep what the store lacks, with a progress bar, in an order of this process's
    own: the jobs of a sweep that begin together share the work.

    workers: processes; None for one per core. Other processes are started only when what remains
    would keep this one busy for longer than their start takes.
    """
    missing = {task.key: task for task in tasks if not store.has(task.kind, task.key)}
    queue = list(missing.values())
    random.Random(os.getpid()).shuffle(queue)
    workers = min(workers or cpu_count(), len(queue))
    progress = tqdm(total=len(queue), desc=description, delay=1.0)
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
    if not store.has(task.kind, task.key):  # another process may have been here
        store.save(task.kind, task.key, task.compute(*task.arguments))


def _run_in_pool(tasks: list[Task], store: Store, workers: int, progress: tqdm) -> None:
    # idle workers would stay for five minutes, with their memory
    pool = Parallel(n_jobs=workers, return_as="generator_unordered", idle_worker_timeout=2)
    try:
        for _ in pool(delayed(_run)(task, store) for task in tasks):
            progress.update()
    except TerminatedWorkerError as error:
        raise DataError(
            "a process was killed, probably for lack of memory: data.workers=1 needs "
            "less; the same command goes on"
        ) from error


def load_task(task: Task, store: Store) -> Arrays:
    """The result of a task, from the store if it is there and sound, else computed again."""
    return store.get(task.kind, task.key, lambda: task.compute(*task.arguments))
