"""What a data set gives: a template, named shapes with labels, and a split."""

from __future__ import annotations

import zipfile
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from meshspiral.geometry.mesh import Mesh

SPLITS = ("train", "val", "test")


class DataError(ValueError):
    """A data set that is missing or wrong; the message says what, where, and what would mend it."""


class SurfacePoints(NamedTuple):
    """Points on the template: corners int64 [V, 3], the vertices of a face, and weights float64
    [V, 3], the barycentric coordinates in it."""

    corners: np.ndarray
    weights: np.ndarray


@dataclass(frozen=True, eq=False)
class Shape:
    """One mesh with its ground truth.

    labels: int64 [V], for every vertex its counterpart, a vertex of the data set's template.
    points: where on the template the counterpart lies exactly, if it lies within a face; the label
    is then the nearest vertex. DataError is raised for a wrong count or a label outside the
    template.
    """

    mesh: Mesh
    labels: np.ndarray
    template_size: int
    points: SurfacePoints | None = None

    def __post_init__(self) -> None:
        labels = np.ascontiguousarray(self.labels, dtype=np.int64)
        vertices = len(self.mesh.vertices)
        if labels.shape != (vertices,):
            raise DataError(f"{self.mesh.name}: {vertices} vertices but labels {labels.shape}")
        self._within(labels, "labels")
        object.__setattr__(self, "labels", labels)
        if self.points is not None:
            corners = np.ascontiguousarray(self.points.corners, dtype=np.int64)
            weights = np.ascontiguousarray(self.points.weights, dtype=np.float64)
            if corners.shape != (vertices, 3) or weights.shape != (vertices, 3):
                raise DataError(
                    f"{self.mesh.name}: {vertices} vertices but points on the template "
                    f"{corners.shape}, {weights.shape}"
                )
            self._within(corners.min(axis=1), "points")
            self._within(corners.max(axis=1), "points")
            object.__setattr__(self, "points", SurfacePoints(corners, weights))

    def _within(self, vertices: np.ndarray, what: str) -> None:
        bad = np.flatnonzero((vertices < 0) | (vertices >= self.template_size))
        if len(bad):
            raise DataError(
                f"{self.mesh.name}: {len(bad)} {what} outside 0..{self.template_size - 1}, "
                f"the template's vertices; first: vertex {bad[0]} has {vertices[bad[0]]}"
            )

    def renumbered(self, order: np.ndarray) -> Shape:
        """The same shape with vertex order[i] at place i."""
        points = self.points and SurfacePoints(*(array[order] for array in self.points))
        return Shape(self.mesh.renumbered(order), self.labels[order], self.template_size, points)


class ShapeSet(ABC):
    """A data set. Meshes are read when asked for, not before.

    template: the reference mesh whose vertices are the labels and on which errors are measured.
    names: for each of "train", "val" and "test" the names of its shapes, in a fixed order.
    up: the axis, "y" or "z", that points up; only pictures ask for it.
    """

    template: Mesh
    names: dict[str, list[str]]
    up = "y"

    def prepare(self, names: list[str]) -> None:  # noqa: B027
        """Compute what `load` needs for those shapes, if it needs any such thing."""

    @abstractmethod
    def load(self, name: str) -> Shape:
        """The shape of that name. Errors: MeshError, DataError."""


def subject_split(names: list[str], per_subject: int = 10) -> dict[str, list[str]]:
    """The paper's 70/10/20 split of 100 shapes in FAUST's order.

    Shape i shows subject i // 10 in pose i % 10; subjects 0-6 train, 7 validates, 8 and 9 test, so
    that validation and test show people never seen in training.
    """
    subjects = [names[i : i + per_subject] for i in range(0, len(names), per_subject)]
    groups = {"train": subjects[:7], "val": subjects[7:8], "test": subjects[8:]}
    return {split: [n for subject in group for n in subject] for split, group in groups.items()}


def registered_shape(mesh: Mesh, template: Mesh) -> Shape:
    """The shape of a mesh numbered like the template: its labels are its vertex numbers.

    Errors: DataError where the two have different numbers of vertices.
    """
    size = len(template.vertices)
    if len(mesh.vertices) != size:
        raise DataError(
            f"{mesh.name}: {len(mesh.vertices)} vertices, but the template {template.name} has "
            f"{size}; a registered mesh has the template's vertices in the template's order"
        )
    return Shape(mesh, np.arange(size), size)


def read_labels(path: str | Path, vertices: int | None = None) -> np.ndarray:
    """The labels of one mesh, int64 [V]: for every vertex in its order a vertex of the template.

    path: a text file with one whole number a line, or a `.npy` of integers [V]. vertices: the V
    to insist on. Errors: DataError, with the path, for a file that is missing or holds anything
    else, or another V. The range is not checked here but by `Shape`, which knows the template.
    """
    path = Path(path)
    try:
        labels = _array(path) if path.suffix == ".npy" else _column(path)
    except OSError as error:
        raise DataError(f"{path}: cannot read the labels ({error.strerror or error})") from error
    if vertices is not None and len(labels) != vertices:
        raise DataError(f"{path}: {len(labels)} labels for a mesh of {vertices} vertices")
    return labels


def _array(path: Path) -> np.ndarray:
    try:
        labels = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise DataError(f"{path}: not a readable .npy file ({error})") from error
    kind = getattr(labels, "dtype", None), getattr(labels, "shape", None)
    if kind[0] is None or kind[0].kind not in "iu" or len(kind[1]) != 1:
        raise DataError(f"{path}: labels must be integers [V], got {kind[0]} {kind[1]}")
    return labels.astype(np.int64)


def _column(path: Path) -> np.ndarray:
    lines = path.read_text(encoding="utf-8-sig", errors="replace").rstrip().splitlines()
    labels = np.empty(len(lines), dtype=np.int64)
    for i, line in enumerate(lines):
        try:
            labels[i] = int(line)
        except (ValueError, OverflowError) as error:
            raise DataError(
                f"{path}: line {i + 1} is {line[:40]!r}, not the number of a template vertex"
            ) from error
    return labels
