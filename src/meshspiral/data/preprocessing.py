"""From a mesh to the arrays that a network reads, each computed once and cached."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from types import ModuleType

import numpy as np

from meshspiral.data.cache import Arrays, Cache, code_version
from meshspiral.data.descriptors import Descriptor
from meshspiral.data.pool import run_all
from meshspiral.geometry import mesh as meshes
from meshspiral.geometry import shot
from meshspiral.geometry.digest import digest
from meshspiral.geometry.mesh import Mesh, MeshError
from meshspiral.geometry.shot import Frame
from meshspiral.neighbourhoods import Neighbourhood

# libraries whose versions geodesics and Laplacians depend on
LIBRARIES = [f"{name} {metadata.version(name)}" for name in ("potpourri3d", "scipy")]


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
    key = digest(mesh.vertices, mesh.faces, mesh.complete_area, *frame, version)
    return Task("frames", key, _frames, (mesh, frame))


def descriptor_task(mesh: Mesh, descriptor: Descriptor, half: bool = False) -> Task:
    """A descriptor: `features` float32 [V, C], zeros where it is undefined, and `undefined`, the
    number of such vertices. With `half`, features are float16."""
    key = _descriptor_key(mesh, descriptor, *(["float16"] if half else []))
    compute = partial(_described, descriptor, np.float16 if half else np.float32)
    return Task(descriptor.name, key, compute, _inputs(descriptor, mesh))


def measure_task(mesh: Mesh, descriptor: Descriptor) -> Task:
    """What an unfitted descriptor measures of a training shape: `measured`."""
    key = _descriptor_key(mesh, descriptor)
    return Task(f"{descriptor.name}-fit", key, partial(_measured, descriptor), (mesh,))


def _descriptor_key(mesh: Mesh, descriptor: Descriptor, *more: str) -> str:
    return digest(
        *more,
        repr(sorted(descriptor.settings.model_dump().items())),
        mesh.vertices,
        mesh.faces,
        mesh.complete_area,
        code_version(*descriptor.modules, *sources(descriptor), meshes, sys.modules[__name__]),
        *LIBRARIES,
    )


def neighbourhood_task(mesh: Mesh, neighbourhood: Neighbourhood) -> Task:
    """The arrays of a neighbourhood, see its `compute`."""
    modules = (*neighbourhood.modules, *sources(neighbourhood), meshes, sys.modules[__name__])
    version = code_version(*modules)
    settings = sorted(neighbourhood.settings.model_dump().items())
    key = digest(repr(settings), *neighbourhood.mesh_key(mesh), version, *LIBRARIES)
    inputs = _inputs(neighbourhood, mesh)
    return Task(neighbourhood.name, key, neighbourhood.compute, inputs)


def sources(described: Descriptor | Neighbourhood) -> list[ModuleType]:
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
    radius = frame.support * mesh.size
    return {"frames": shot.local_frames(mesh.centred, radius, masses)}


def _described(
    descriptor: Descriptor, dtype: type[np.floating], mesh: Mesh, *frames: np.ndarray
) -> Arrays:
    _check_area(mesh)
    features = descriptor.compute(mesh, *frames)
    undefined = np.isnan(features).any(axis=1)
    features[undefined] = 0.0
    return {"features": features.astype(dtype, copy=False), "undefined": np.array(undefined.sum())}


def _measured(descriptor: Descriptor, mesh: Mesh) -> Arrays:
    return {"measured": descriptor.measure(mesh)}


def _check_area(mesh: Mesh) -> None:
    if mesh.area == 0:
        raise MeshError(f"{mesh.name}: surface area must be above 0 to scale descriptors, got 0")


def run_tasks(tasks: Iterable[Task], cache: Cache, workers: int | None, description: str) -> None:
    """Compute and cache what the cache lacks, with a progress bar.

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
    run_all(partial(ensure_task, cache=cache), list(missing.values()), workers, description)


def ensure_task(task: Task, cache: Cache) -> None:
    """Compute and cache a result that the cache lacks."""
    if not cache.has(task.kind, task.key):  # another process may have computed it meanwhile
        cache.save(task.kind, task.key, compute_task(task, cache))


def load_task(task: Task, cache: Cache, check: bool = True) -> Arrays:
    """The result of a task: from the cache, or computed if it is missing or damaged there."""
    return cache.get(task.kind, task.key, lambda: compute_task(task, cache), check)


def compute_task(task: Task, cache: Cache | None = None) -> Arrays:
    """Compute a task, and those among its arguments; the latter through the cache, if given."""
    arguments = []
    for argument in task.arguments:
        if isinstance(argument, Task):
            load = compute_task if cache is None else load_task
            argument = next(iter(load(argument, cache).values()))
        arguments.append(argument)
    return task.compute(*arguments)
