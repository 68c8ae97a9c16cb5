"""The outcome of a test: predictions and errors of all vertices, and the file that holds them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from meshspiral.data.files import write_arrays
from meshspiral.data.reference import ReferenceDistances
from meshspiral.data.shapes import SurfacePoints
from meshspiral.evaluation.metrics import (
    CorrespondenceError,
    at_vertices,
    geodesic_errors,
    point_errors,
)
from meshspiral.experiment.run_folder import RunError
from meshspiral.neighbourhoods.base import Batch


class Result(NamedTuple):
    """Predictions and errors of one mesh.

    Attributes:
        predicted: Template vertices, int64 [V].
        errors: Distance from the true point over sqrt(area), float64 [V].
        label_errors: Distance from the label over sqrt(area), float64 [V].
    """

    predicted: np.ndarray
    errors: np.ndarray
    label_errors: np.ndarray


def result_of(predicted: np.ndarray, batch: Batch, distances: ReferenceDistances) -> Result:
    """Compute the errors of a prediction.

    Args:
        predicted: Template vertices, int64 [V].
        batch: The mesh, an item of `MeshDataset`.
        distances: Distances on the template.
    """
    to_label = geodesic_errors(predicted, batch["labels"].cpu().numpy(), distances)
    if "corners" not in batch:
        return Result(predicted, to_label, to_label)
    errors = point_errors(at_vertices(predicted), true_points(batch), distances, distances.place)
    return Result(predicted, errors, to_label)


def true_points(batch: Batch) -> SurfacePoints:
    """The true points of a mesh, an item of `MeshDataset`: its labels, if these are exact."""
    if "corners" not in batch:
        return at_vertices(batch["labels"].cpu().numpy())
    return SurfacePoints(batch["corners"].cpu().numpy(), batch["weights"].cpu().numpy())


@dataclass(frozen=True, eq=False)
class Outcome:
    """Predictions and errors on M meshes, as saved in errors.npz. K is the sum of all V.

    Attributes:
        names: Names of the meshes; M entries.
        first: int64 [M + 1]; mesh m has the entries first[m]:first[m + 1] of the arrays below.
        predicted: Predicted template vertices, int32 [K].
        labels: Labels, int32 [K].
        errors: Geodesic distance on the template from the predicted vertex to the true point, over
            the square root of the template's area, float32 [K].
        label_errors: The same distance to the label, float32 [K].
        diameter: Geodesic diameter of the template over the square root of its area.
    """

    names: list[str]
    first: np.ndarray
    predicted: np.ndarray
    labels: np.ndarray
    errors: np.ndarray
    label_errors: np.ndarray
    diameter: float

    @classmethod
    def of(
        cls,
        names: list[str],
        items: Sequence[Batch],
        results: Mapping[int, Result],
        diameter: float,
    ) -> Outcome:
        """The outcome of the meshes that have a result.

        Args:
            names: Names of all meshes.
            items: Items of `MeshDataset` of all meshes.
            results: Results by index into `names` and `items`.
            diameter: Geodesic diameter of the template over the square root of its area.
        """
        chosen = sorted(results)
        columns = [
            np.concatenate(column) for column in zip(*(results[i] for i in chosen), strict=True)
        ]
        labels = np.concatenate([items[i]["labels"].numpy() for i in chosen])
        sizes = [len(results[i].predicted) for i in chosen]
        return cls(
            [names[i] for i in chosen],
            np.concatenate([[0], np.cumsum(sizes)]),
            columns[0].astype(np.int32),
            labels.astype(np.int32),
            columns[1].astype(np.float32),
            columns[2].astype(np.float32),
            float(diameter),
        )

    def mesh(self, name: str) -> slice:
        """The entries of a mesh, by its name."""
        i = self.names.index(name)
        return slice(int(self.first[i]), int(self.first[i + 1]))

    def metrics(self) -> tuple[dict[str, float], np.ndarray]:
        """Pool all vertices.

        Returns:
            The metrics of metrics.json, without their prefix "test/"; and the curve, float64 [T]
            over THRESHOLDS. `geodesic_error_to_label` is only given where true points lie within
            faces.
        """
        pooled = CorrespondenceError()
        pooled.update(self.errors, self.predicted == self.labels)
        values = pooled.compute()
        curve = values.pop("curve").numpy()
        metrics = {name: float(value) for name, value in values.items()}
        metrics["geodesic_error_diameter"] = metrics["geodesic_error"] / self.diameter
        if self.error_to_label is not None:
            metrics["geodesic_error_to_label"] = self.error_to_label
        return metrics, curve

    @property
    def error_to_label(self) -> float | None:
        """The mean error to the label; None where the true point is that vertex itself."""
        if np.array_equal(self.errors, self.label_errors):
            return None
        return float(self.label_errors.mean(dtype=np.float64))

    def save(self, path: Path) -> None:
        """Write the file."""
        write_arrays(path, **{f.name: np.asarray(getattr(self, f.name)) for f in fields(self)})

    @classmethod
    def load(cls, path: Path) -> Outcome:
        """Read a file that `save` wrote.

        Raises:
            RunError: The file does not exist, is damaged, or is of another kind.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {f.name: file[f.name] for f in fields(cls)}
            names, diameter = arrays.pop("names").tolist(), float(arrays.pop("diameter"))
            first = arrays["first"]
            lengths = {len(array) for name, array in arrays.items() if name != "first"}
            if len(first) != len(names) + 1 or lengths != {int(first[-1])}:
                raise ValueError("its arrays have different lengths")
        except FileNotFoundError:
            raise RunError(f"{path} does not exist") from None
        except Exception as error:  # NumPy raises many types for damaged files
            raise RunError(f"{path} is damaged ({str(error)[:100]})") from error
        return cls(names, diameter=diameter, **arrays)


class Rotations(NamedTuple):
    """Results of R repetitions of a test, each with other random spirals.

    Attributes:
        curves: float64 [R, T] over THRESHOLDS.
        exact_match: Exact-match rates, float64 [R].
        geodesic_error: Mean errors over sqrt(area), float64 [R].
        unchanged: Share of vertices whose prediction is the same in all repetitions.
    """

    curves: np.ndarray
    exact_match: np.ndarray
    geodesic_error: np.ndarray
    unchanged: float

    def metrics(self) -> dict[str, float]:
        """Mean, standard deviation, minimum and maximum over the repetitions, for metrics.json."""
        metrics: dict[str, float] = {"unchanged": self.unchanged, "runs": len(self.curves)}
        for name in ("exact_match", "geodesic_error"):
            values = getattr(self, name)
            statistics = {
                "mean": values.mean(),
                "spread": values.std(),
                "least": values.min(),
                "most": values.max(),
            }
            metrics |= {f"{name}/{key}": float(value) for key, value in statistics.items()}
        return metrics


def rotations(runs: Iterable[list[Result]], labels: list[np.ndarray]) -> Rotations:
    """Pool repetitions of a test.

    Args:
        runs: For each repetition, the results of all meshes.
        labels: Labels of each mesh, int64 [V].
    """
    curves, exact, errors, first, same = [], [], [], None, None
    for run in runs:
        pooled = CorrespondenceError()
        for mesh, truth in zip(run, labels, strict=True):
            pooled.update(mesh.errors, mesh.predicted == truth)
        values = pooled.compute()
        curves.append(values["curve"].numpy())
        exact.append(float(values["exact_match"]))
        errors.append(float(values["geodesic_error"]))
        predicted = np.concatenate([mesh.predicted for mesh in run])
        first = predicted if first is None else first
        same = predicted == first if same is None else same & (predicted == first)
    return Rotations(np.array(curves), np.array(exact), np.array(errors), float(same.mean()))


def evenly(names: list[str], count: int) -> list[str]:
    """Choose at most `count` names, evenly spread: in FAUST's order they then differ in pose."""
    indices = np.linspace(0, len(names) - 1, min(count, len(names)))
    return [names[i] for i in np.unique(indices.round().astype(int))]


def json_ready(metrics: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """The metrics with the prefix that they have in metrics.json, e.g. "test"."""
    return {f"{prefix}/{name}": value for name, value in metrics.items()}
