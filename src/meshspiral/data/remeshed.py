"""A data set with every shape remeshed separately, so that connectivity does not reveal labels."""

from __future__ import annotations

import sys
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from meshspiral.data.cache import Arrays, Cache, code_version
from meshspiral.data.preprocessing import Task, load_task, run_tasks
from meshspiral.data.shapes import (
    DataError,
    Shape,
    ShapeSet,
    SurfacePoints,
    epoch_of,
    name_in,
    nearest_labels,
)
from meshspiral.geometry import mesh as meshes
from meshspiral.geometry import remesh
from meshspiral.geometry.barycentric import interpolate
from meshspiral.geometry.digest import derived_seed, digest
from meshspiral.geometry.mesh import Mesh, used_vertices

FUSING = ("fused", "scans")  # policies that join parts which are apart in another shape
TEAR = 4.0  # growth at which a face tears; that of skin is mostly below


class Remeshed(ShapeSet):
    """The shapes of another data set, each with its own tessellation, computed once and cached.

    Template, names and split are those of the other data set. The ground truth of a vertex is the
    point of the template that corresponds to its closest point on the original shape; its label is
    the nearest corner of that point's face. The seed of a tessellation derives from the content of
    the shape. In a later epoch, a shape to train on has another tessellation.

    Args:
        base: The other data set.
        cache: Cache of the remeshed shapes.
        workers: Number of processes; None for one per core.
        policy: Kind of tessellation (see `meshspiral.geometry.remesh.remesh`).
        vertices: Number of vertices of a remeshed shape, or a range from which each shape draws its
            number, as often small as large; None for `usual_size` of the template.
        copies: Number of tessellations of each training shape. Copy k > 1 is named "<name>~k".
        shared: Number of tessellations that the training shapes share, which saves the time of
            remeshing each: a shape is remeshed as the one whose tessellation it draws. All must
            have the same faces. None: every shape has its own.

    Raises:
        DataError: PyMeshLab is not installed, or `shared` is more than the training shapes.
    """

    fresh = True

    def __init__(
        self,
        base: ShapeSet,
        cache: Cache,
        workers: int | None,
        policy: str,
        vertices: int | list[int] | None,
        copies: int = 1,
        shared: int | None = None,
    ) -> None:
        try:
            self._version = version("pymeshlab")
        except PackageNotFoundError as error:
            raise DataError("remeshing needs PyMeshLab: pip install pymeshlab") from error
        self.base, self._cache, self._workers = base, cache, workers
        self._policy = policy
        self._vertices = vertices or usual_size(len(base.template.vertices))
        self.template, self.up = base.template, base.up
        originals = base.names["train"]
        self._copies = {
            f"{name}~{copy}": (name, copy) for copy in range(2, copies + 1) for name in originals
        }
        self.names = {**base.names, "train": [*originals, *self._copies]}
        if shared and shared > len(originals):
            raise DataError(
                f"data.remesh.shared must be at most {len(originals)}, the number of training "
                f"shapes, got {shared}"
            )
        self._shared = originals[:: len(originals) // shared][:shared] if shared else []
        self._train, self._number = set(self.names["train"]), copies

    def prepare(self, names: list[str]) -> None:
        self.base.prepare(sorted({self._original(name)[0] for name in names}))
        tasks = [self._tessellation(name)[1] for name in names]
        run_tasks(tasks, self._cache, self._workers, "Remeshing")

    def load(self, name: str) -> Shape:
        source = self.source(name)
        pattern, task = self._tessellation(name, source)
        arrays = load_task(task, self._cache)
        if pattern is not None and not np.array_equal(pattern.mesh.faces, source.mesh.faces):
            raise DataError(
                f"{name}: the faces are not those of {pattern.mesh.name}; data.remesh.shared "
                "needs shapes with the same faces"
            )
        corners, weights = source.mesh.faces[arrays["face"]], arrays["weights"]
        vertices, faces = arrays["vertices"], arrays["faces"]
        if pattern is not None:
            before, vertices = vertices, interpolate(source.mesh.vertices, corners, weights)
            if self._policy in FUSING:
                used, faces = used_vertices(faces[~torn(before, vertices, faces)])
                vertices, corners, weights = vertices[used], corners[used], weights[used]
        mesh = Mesh(vertices, faces, source.mesh.name)
        template = self.template.vertices
        if source.points is None:
            corners = source.labels[corners]
            point = interpolate(template, corners, weights)
        else:
            place = interpolate(template, *source.points)
            point = interpolate(place, corners, weights)
            any_normal = np.full_like(point, np.nan)
            face, weights, _ = remesh.closest_points(self.template, point, any_normal)
            corners = self.template.faces[face]
        labels = nearest_labels(self.template, corners, point)
        return Shape(mesh, labels, len(template), SurfacePoints(corners, weights))

    def stamp(self, name: str) -> str | None:
        original, copy = self._original(name)
        stamp = self.base.stamp(original)
        if stamp is None:
            return None
        code = code_version(remesh, meshes, sys.modules[__name__])
        settings = f"{self._policy}|{self._vertices}|{copy}|{len(self._shared)}"
        if pattern := self._pattern(name):
            settings += f"|{self.base.stamp(pattern)}"
        return f"{stamp}|{settings}|{code}|{self._version}"

    def source(self, name: str) -> Shape:
        return self.base.load(self._original(name)[0])

    def _original(self, name: str) -> tuple[str, int]:
        """Name of the shape in the other data set, and the number of this copy, counted from 1."""
        name, epoch = epoch_of(name)
        original, copy = self._copies.get(name, (name, 1))
        if self.base.fresh:
            return name_in(epoch, original), copy
        return original, copy + epoch * self._number

    def _pattern(self, name: str) -> str | None:
        """The name of the shape whose tessellation a shape shares; None if it has its own."""
        if not (self._shared and epoch_of(name)[0] in self._train):
            return None
        return self._shared[derived_seed("tessellation", name) % len(self._shared)]

    def _tessellation(self, name: str, source: Shape | None = None) -> tuple[Shape | None, Task]:
        """The shape whose tessellation a shape shares, None if it has its own; and its task.

        `source` is the original shape, where it is known already: Anny makes each anew.
        """
        if shared := self._pattern(name):
            pattern = self.base.load(shared)
            return pattern, self._task(pattern.mesh, 1)
        source = source or self.source(name)
        return None, self._task(source.mesh, self._original(name)[1])

    def _task(self, source: Mesh, copy: int) -> Task:
        content = (source.vertices, source.faces, self._policy, *([copy] if copy > 1 else []))
        code = code_version(remesh, meshes)
        seed = derived_seed(*content)
        vertices = self._vertices
        if isinstance(vertices, list):
            draw = np.random.default_rng(derived_seed(*content, "vertices")).uniform
            vertices = round(np.exp(draw(*np.log(vertices))))
        key = digest(*content, vertices, code, self._version)
        return Task("meshes", key, _remesh, (source, vertices, self._policy, seed, copy > 1))


def torn(before: np.ndarray, after: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Whether a face of a shared tessellation spans parts that touch in one shape but not another.

    Args:
        before: Vertices of the shape whose tessellation it is, float [V, 3].
        after: Vertices of the shape that it is carried to, float [V, 3].
        faces: int [F, 3].

    Returns:
        bool [F]: whether an edge grows more than TEAR times as much as the median edge.
    """
    one, other = faces, np.roll(faces, 1, axis=1)
    lengths = [np.linalg.norm(x[one] - x[other], axis=2) for x in (before, after)]
    growth = lengths[1] / np.maximum(lengths[0], 1e-12 * lengths[0].max())
    return (growth > TEAR * np.median(growth)).any(axis=1)


def usual_size(vertices: int) -> int:
    """Number of vertices of a remeshed shape: 5000 for FAUST's 6890, else in proportion.

    Args:
        vertices: Number of vertices of the template.

    Returns:
        The number, rounded to hundreds above 1000, and at least 12.
    """
    size = vertices * 5000 / 6890
    return round(size / 100) * 100 if size > 1000 else max(12, round(size))


def _remesh(source: Mesh, vertices: int, policy: str, seed: int, turned: bool) -> Arrays:
    made = remesh.remesh(source, vertices, policy, seed, turned)
    return {
        "vertices": made.mesh.vertices,
        "faces": made.mesh.faces.astype(np.int32),
        "face": made.faces.astype(np.int32),
        "weights": made.weights,
    }
