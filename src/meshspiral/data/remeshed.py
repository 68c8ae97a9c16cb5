"""Any data set with each shape remeshed on its own: no connectivity gives a vertex away."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

import numpy as np

from meshspiral.data.cache import Arrays, Store, code_version, digest
from meshspiral.data.preprocessing import Task, load_task, run_tasks
from meshspiral.data.shapes import DataError, Shape, ShapeSet, SurfacePoints
from meshspiral.geometry import mesh as meshes
from meshspiral.geometry import remesh
from meshspiral.geometry.mesh import Mesh


class Remeshed(ShapeSet):
    """The shapes of another set, each with a tessellation of its own, made once and kept.

    Its template, names and split are those of the other set. The truth of a vertex is a point of
    the template: the one that its closest point on the original shape stands for; its label is the
    nearest corner of that face. policy, vertices: as `meshspiral.geometry.remesh.remesh` takes them; None
    for `usual_size`. The seed is drawn from the shape's content. copies: so many tessellations of
    each training shape. Errors: DataError without PyMeshLab.
    """

    def __init__(
        self,
        base: ShapeSet,
        store: Store,
        workers: int | None,
        policy: str,
        vertices: int | None,
        copies: int = 1,
    ) -> None:
        try:
            self._version = version("pymeshlab")
        except PackageNotFoundError as error:
            raise DataError("remeshing needs PyMeshLab: pip install -e '.[remesh]'") from error
        self._base, self._store, self._workers = base, store, workers
        self._policy = policy
        self._vertices = vertices or usual_size(len(base.template.vertices))
        self.template, self.up = base.template, base.up
        once, further = base.names["train"], range(2, copies + 1)
        self._copies = {f"{name}~{copy}": (name, copy) for copy in further for name in once}
        self.names = {**base.names, "train": [*once, *self._copies]}

    def prepare(self, names: list[str]) -> None:
        self._base.prepare(sorted({self._of(name)[0] for name in names}))
        tasks = [self._task(self.source(name).mesh, self._of(name)[1]) for name in names]
        run_tasks(tasks, self._store, self._workers, "Remeshing")

    def load(self, name: str) -> Shape:
        source = self.source(name)
        kept = load_task(self._task(source.mesh, self._of(name)[1]), self._store)
        corners = source.labels[source.mesh.faces[kept["face"]]]
        shape = Mesh(kept["vertices"], kept["faces"], source.mesh.name)
        place = self.template.vertices
        point = np.einsum("vk,vkx->vx", kept["weights"], place[corners])
        nearest = np.linalg.norm(place[corners] - point[:, None], axis=2).argmin(axis=1)
        labels = corners[np.arange(len(corners)), nearest]
        points = SurfacePoints(corners, kept["weights"])
        return Shape(shape, labels, len(place), points)

    def source(self, name: str) -> Shape:
        """The shape that the one of that name was made from."""
        return self._base.load(self._of(name)[0])

    def _of(self, name: str) -> tuple[str, int]:
        """The name of the shape in the other set, and which of its copies that is."""
        return self._copies.get(name, (name, 1))

    def _task(self, source: Mesh, copy: int) -> Task:
        what = (source.vertices, source.faces, self._policy, *([copy] if copy > 1 else []))
        code = code_version(remesh, meshes)
        key = digest(*what, self._vertices, code, self._version)
        seed = int(digest(*what)[:15], 16)
        return Task("meshes", key, _remesh, (source, self._vertices, self._policy, seed))


def usual_size(vertices: int) -> int:
    """The vertices of a remeshed shape for so many of the template: 5000 for FAUST's 6890 and in
    proportion for others, to the hundred if there are that many."""
    size = vertices * 5000 / 6890
    return round(size, -2) if size > 1000 else max(12, round(size))


def _remesh(source: Mesh, vertices: int, policy: str, seed: int) -> Arrays:
    made = remesh.remesh(source, vertices, policy, seed)
    return {
        "vertices": made.mesh.vertices,
        "faces": made.mesh.faces.astype(np.int32),
        "face": made.faces.astype(np.int32),
        "weights": made.weights,
    }
