"""The base of data sets: a template, named shapes with labels, and a split."""

from __future__ import annotations

import zipfile
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from meshspiral.data.settings import DataSettings
from meshspiral.geometry.mesh import Mesh

SPLITS = ("train", "val", "test")


class DataError(ValueError):
    """A data set is missing or invalid. The message says what, where, and how to fix it."""


class SurfacePoints(NamedTuple):
    """Points on the template in barycentric coordinates.

    Attributes:
        corners: Vertices of the face of each point, int64 [V, 3].
        weights: Barycentric coordinates in that face, float64 [V, 3].
    """

    corners: np.ndarray
    weights: np.ndarray


@dataclass(frozen=True, eq=False)
class Shape:
    """A mesh with its ground truth.

    Args:
        mesh: The mesh, with V vertices.
        labels: Template vertex that corresponds to each vertex, int64 [V].
        template_size: Number of vertices of the template.
        points: Points of the template that correspond exactly, where they lie within faces; the
            labels are then the nearest vertices. None if only labels are known.

    Raises:
        DataError: Labels or points have the wrong shape or name vertices outside the template.
    """

    mesh: Mesh
    labels: np.ndarray
    template_size: int
    points: SurfacePoints | None = None

    def __post_init__(self) -> None:
        labels = np.ascontiguousarray(self.labels, dtype=np.int64)
        vertices = len(self.mesh.vertices)
        if labels.shape != (vertices,):
            raise DataError(
                f"{self.mesh.name}: {vertices} vertices but labels {labels.shape}; "
                f"labels must have shape ({vertices},)"
            )
        self._check_range(labels, "labels")
        object.__setattr__(self, "labels", labels)
        if self.points is not None:
            corners = np.ascontiguousarray(self.points.corners, dtype=np.int64)
            weights = np.ascontiguousarray(self.points.weights, dtype=np.float64)
            if corners.shape != (vertices, 3) or weights.shape != (vertices, 3):
                raise DataError(
                    f"{self.mesh.name}: {vertices} vertices but points on the template with "
                    f"corners {corners.shape} and weights {weights.shape}; "
                    f"both must have shape ({vertices}, 3)"
                )
            self._check_range(corners.min(axis=1), "points")
            self._check_range(corners.max(axis=1), "points")
            object.__setattr__(self, "points", SurfacePoints(corners, weights))

    def _check_range(self, vertices: np.ndarray, noun: str) -> None:
        bad = np.flatnonzero((vertices < 0) | (vertices >= self.template_size))
        if len(bad):
            raise DataError(
                f"{self.mesh.name}: {len(bad)} {noun} outside 0..{self.template_size - 1}, "
                f"the vertices of the template; first: vertex {bad[0]} has {vertices[bad[0]]}"
            )

    def renumbered(self, order: np.ndarray) -> Shape:
        """The shape with its vertices renumbered: new vertex i is old vertex order[i].

        Args:
            order: A permutation, int64 [V].
        """
        points = self.points and SurfacePoints(*(array[order] for array in self.points))
        return Shape(self.mesh.renumbered(order), self.labels[order], self.template_size, points)


class ShapeSet(ABC):
    """A data set: a template, named shapes, and a split. Meshes are read when asked for.

    A subclass registers under a name, `class Bodies(ShapeSet, name="bodies")`. The fields that its
    `Settings` adds to `DataSettings` are the arguments of its constructor.

    Attributes:
        registered: All data sets, by name.
        template: The reference mesh: labels are its vertices, and errors are measured on it.
        names: For each of "train", "val" and "test" the names of its shapes, in a fixed order.
        up: The axis that points up in pictures, "y" or "z".
        fresh: Whether `load` knows other versions of the shapes to train on, one for each epoch, by
            names as `name_in` gives them.
        base: The data set whose shapes this one changes, if it does.
    """

    registered: ClassVar[dict[str, type[ShapeSet]]] = {}
    Settings: ClassVar[type[DataSettings]] = DataSettings
    template: Mesh
    names: dict[str, list[str]]
    up = "y"
    fresh = False
    base: ShapeSet | None = None

    def __init_subclass__(cls, name: str | None = None, **options: Any) -> None:
        super().__init_subclass__(**options)
        if name is not None:
            ShapeSet.registered[name] = cls

    def prepare(self, names: list[str]) -> None:  # noqa: B027  (an optional hook)
        """Compute what `load` needs for these shapes, if anything."""

    def stamp(self, name: str) -> str | None:
        """What changes whenever the content of a shape may have changed, found without reading it.

        With it, a start does not read meshes whose results are cached. None, the default: each is
        read. Settings alone do not suffice where files can change; `file_stamp` helps.
        """
        return None

    def source(self, name: str) -> Shape | None:
        """The shape before it was remeshed; None if it was not.

        Args:
            name: As for `load`.

        Raises:
            DataError, MeshError: As `load` does.
        """
        return self.base and self.base.source(name)

    @abstractmethod
    def load(self, name: str) -> Shape:
        """Load a shape.

        Args:
            name: One of `names`; if `fresh`, also what `name_in` makes of one of "train".

        Raises:
            DataError: There is no such shape, or its data are unusable.
            MeshError: Its mesh is unusable.
        """


def name_in(epoch: int, name: str) -> str:
    """The name of the version of a shape that an epoch is trained on: "name@2" in the third."""
    return f"{name}@{epoch}" if epoch else name


def epoch_of(name: str) -> tuple[str, int]:
    """The name of the shape and the epoch of which `name_in` made a name."""
    name, _, epoch = name.partition("@")
    return name, int(epoch or 0)


def file_stamp(*paths: Path | None) -> str:
    """Names, sizes and times of files, for `ShapeSet.stamp`; a missing file has none."""
    return "|".join(f"{path.absolute()}:{_size_and_time(path)}" for path in paths if path)


def _size_and_time(path: Path) -> str:
    try:
        status = path.stat()
    except OSError:
        return "missing"
    return f"{status.st_size}:{status.st_mtime_ns}"


def subject_split(names: list[str], per_subject: int = 10) -> dict[str, list[str]]:
    """The 70/10/20 split of Lim et al. 2018 for 100 shapes in FAUST's order.

    Shape i shows subject i // 10 in pose i % 10. Subjects 0-6 train, 7 validates, 8 and 9 test, so
    validation and test show subjects that are not in training.

    Args:
        names: Names of the shapes, in this order.
        per_subject: Number of poses per subject.

    Returns:
        The names of "train", "val" and "test".
    """
    subjects = [names[i : i + per_subject] for i in range(0, len(names), per_subject)]
    groups = {"train": subjects[:7], "val": subjects[7:8], "test": subjects[8:]}
    return {split: [n for subject in group for n in subject] for split, group in groups.items()}


def nearest_labels(template: Mesh, corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The corner nearest to each point, int64 [V].

    Args:
        template: The template.
        corners: Its vertices around each point, int64 [V, 3].
        points: Positions near its surface, float64 [V, 3].
    """
    apart = np.linalg.norm(template.vertices[corners] - points[:, None], axis=2)
    return corners[np.arange(len(corners)), apart.argmin(axis=1)]


def registered_shape(mesh: Mesh, template: Mesh) -> Shape:
    """The shape of a mesh in the template's vertex order: vertex i has label i.

    Raises:
        DataError: Mesh and template have different numbers of vertices.
    """
    size = len(template.vertices)
    if len(mesh.vertices) != size:
        raise DataError(
            f"{mesh.name}: {len(mesh.vertices)} vertices, but the template {template.name} has "
            f"{size}; a registered mesh must have the template's vertices in the template's order"
        )
    return Shape(mesh, np.arange(size), size)


def read_labels(path: str | Path, vertices: int | None = None) -> np.ndarray:
    """Read the labels of a mesh.

    Args:
        path: A text file with one integer per line, or a `.npy` file with integers [V].
        vertices: Number of labels V that the file must have; None for any.

    Returns:
        Template vertex that corresponds to each vertex, int64 [V]. The range is not checked here
        but by `Shape`, which knows the template.

    Raises:
        DataError: The file is missing, holds anything else, or has another number of labels.
    """
    path = Path(path)
    try:
        labels = _read_npy(path) if path.suffix == ".npy" else _read_lines(path)
    except OSError as error:
        raise DataError(f"{path}: cannot read the labels ({error.strerror or error})") from error
    if vertices is not None and len(labels) != vertices:
        raise DataError(f"{path}: {len(labels)} labels for a mesh of {vertices} vertices")
    return labels


def _read_npy(path: Path) -> np.ndarray:
    try:
        labels = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise DataError(f"{path}: not a readable .npy file ({error})") from error
    dtype, shape = getattr(labels, "dtype", None), getattr(labels, "shape", None)
    if dtype is None or dtype.kind not in "iu" or len(shape) != 1:
        raise DataError(f"{path}: labels must be integers [V], got {dtype} {shape}")
    return labels.astype(np.int64)


def _read_lines(path: Path) -> np.ndarray:
    lines = path.read_text(encoding="utf-8-sig", errors="replace").rstrip().splitlines()
    labels = np.empty(len(lines), dtype=np.int64)
    for i, line in enumerate(lines):
        try:
            labels[i] = int(line)
        except (ValueError, OverflowError) as error:
            raise DataError(
                f"{path}: line {i + 1} must be the index of a template vertex, got {line[:40]!r}"
            ) from error
    return labels
