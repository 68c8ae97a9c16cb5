"""What a network makes of the test shapes: predictions and errors, and the file that keeps them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from meshspiral.data.datamodule import Batch
from meshspiral.data.reference import ReferenceDistances
from meshspiral.evaluation.metrics import CorrespondenceError, geodesic_errors, point_errors
from meshspiral.experiment.runs import RunError, write_arrays

ERRORS = "errors.npz"


class Result(NamedTuple):
    """One mesh: predicted int64 [V], errors float64 [V] to the true point, and to the label."""

    predicted: np.ndarray
    errors: np.ndarray
    label_errors: np.ndarray


def result_of(predicted: np.ndarray, batch: Batch, distances: ReferenceDistances) -> Result:
    """The errors of a prediction, int64 [V], of a mesh of `MeshDataset`; over sqrt(area)."""
    to_label = geodesic_errors(predicted, batch["labels"].cpu().numpy(), distances)
    if "corners" not in batch:
        return Result(predicted, to_label, to_label)
    point = batch["corners"].cpu().numpy(), batch["weights"].cpu().numpy()
    return Result(predicted, point_errors(predicted, *point, distances, distances.place), to_label)


@dataclass(frozen=True, eq=False)
class Outcome:
    """A test, as errors.npz keeps it.

    names: of the M meshes. first: int64 [M+1]; mesh m has the entries first[m]:first[m+1] of
    predicted and labels, int32 [sum V], vertices of the template, and of errors and label_errors,
    float32 [sum V]: the geodesic distance on the template from the predicted vertex to the true
    point and to the label, over the square root of the template's area. diameter: the template's
    geodesic diameter in the same unit.
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
        cls, names: list[str], items: list[Batch], results: Mapping[int, Result], diameter: float
    ) -> Outcome:
        """Of the meshes that were tested, by their number in names and items."""
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
        """The entries of the mesh of that name."""
        i = self.names.index(name)
        return slice(int(self.first[i]), int(self.first[i + 1]))

    def figures(self) -> tuple[dict[str, float], np.ndarray]:
        """The figures of metrics.json, without their "test/", and the curve over THRESHOLDS."""
        pooled = CorrespondenceError()
        pooled.update(self.errors, self.predicted == self.labels)
        values = pooled.compute()
        curve = values.pop("curve").numpy()
        figures = {name: float(value) for name, value in values.items()}
        figures["geodesic_error_diameter"] = figures["geodesic_error"] / self.diameter
        if not np.array_equal(self.errors, self.label_errors):
            figures["geodesic_error_to_label"] = float(self.label_errors.mean(dtype=np.float64))
        return figures, curve

    def save(self, path: Path) -> None:
        write_arrays(path, **{f.name: np.asarray(getattr(self, f.name)) for f in fields(self)})

    @classmethod
    def load(cls, path: Path) -> Outcome:
        """Errors: RunError for a file that is not there, or not whole, or not one of these."""
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {f.name: file[f.name] for f in fields(cls)}
            names, diameter = arrays.pop("names").tolist(), float(arrays.pop("diameter"))
            first = arrays["first"]
            lengths = {len(array) for name, array in arrays.items() if name != "first"}
            if len(first) != len(names) + 1 or lengths != {int(first[-1])}:
                raise ValueError("its arrays have different lengths")
        except FileNotFoundError:
            raise RunError(f"{path} is not there") from None
        except Exception as error:  # whatever a damaged file makes numpy say
            raise RunError(f"{path} is damaged ({str(error)[:100]})") from error
        return cls(names, diameter=diameter, **arrays)


class Rotations(NamedTuple):
    """The same test with other spirals each time.

    curves: float64 [R, T] over THRESHOLDS. exact_match, geodesic_error: float64 [R].
    unchanged: the share of vertices that got one prediction in all R.
    """

    curves: np.ndarray
    exact_match: np.ndarray
    geodesic_error: np.ndarray
    unchanged: float

    def figures(self) -> dict[str, float]:
        found: dict[str, float] = {"unchanged": self.unchanged, "runs": len(self.curves)}
        for name in ("exact_match", "geodesic_error"):
            values = getattr(self, name)
            told = {
                "mean": values.mean(),
                "spread": values.std(),
                "least": values.min(),
                "most": values.max(),
            }
            found |= {f"{name}/{what}": float(value) for what, value in told.items()}
        return found


def rotations(runs: Iterable[list[Result]], labels: list[np.ndarray]) -> Rotations:
    """Pools runs, each of all meshes. labels: int64 [V] of each mesh."""
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
    """So many of the names, or all, evenly spread: bodies in FAUST's order show other poses."""
    places = np.linspace(0, len(names) - 1, min(count, len(names)))
    return [names[i] for i in np.unique(places.round().astype(int))]


def json_ready(figures: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Flat names for metrics.json."""
    return {f"{prefix}/{name}": value for name, value in figures.items()}
