"""Testing a finished run again, on its own data set or another one with the same template."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from meshspiral.data.datamodule import CorrespondenceData
from meshspiral.data.files import write_file
from meshspiral.data.progress import Progress
from meshspiral.data.shapes import DataError, SurfacePoints
from meshspiral.data.sources import open_data
from meshspiral.evaluation.distributions import (
    SPREAD,
    Distributions,
    near_vertices,
    soft_points,
)
from meshspiral.evaluation.metrics import THRESHOLDS, CorrespondenceError, point_errors
from meshspiral.evaluation.outcome import (
    Outcome,
    Result,
    Rotations,
    evenly,
    result_of,
    rotations,
    true_points,
)
from meshspiral.experiment.run_folder import RunError
from meshspiral.experiment.schema import ConfigError, TrainConfig, read_stored_config
from meshspiral.geometry.digest import digest
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.remesh import closest_points
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.neighbourhoods.base import Batch
from meshspiral.nn.loss import Prediction
from meshspiral.viz.plots import all_curves_figure, encoded

KINDS = ("png", "pdf", "svg")  # of a plot
# data settings that do not change what an evaluation measures
SAME = {"cache_dir", "workers", "readers", "fresh"}
PLOTS = (
    "errors.png",
    "correspondence.png",
    *(f"{plot}.{kind}" for plot in ("curve", "rotations") for kind in KINDS),
)

# Of a batch, for a purpose; see `Predictor`.
Predict = Callable[[Batch, str], Prediction]
PredictDistributions = Callable[[Batch, str], Distributions]


def config_on_data(trained: TrainConfig, requested: dict[str, Any]) -> TrainConfig:
    """The config of a run with other data settings.

    Args:
        trained: The config of the run.
        requested: Data settings that replace those of the run. If they name a data set, only the
            run's descriptors, `shuffle_vertices`, `half`, `cache_dir`, `workers` and `readers`
            remain. `root`, `cache_dir` and `workers` of None count as not requested.

    Raises:
        ConfigError: A setting cannot be used.
    """
    unset = {key for key in ("root", "cache_dir", "workers") if requested.get(key) is None}
    given = {key: value for key, value in requested.items() if key not in unset}
    data = trained.data.model_dump() | {"fresh": False}  # test shapes are always the same
    if "name" in given:
        own = trained.data.own().keys() | {"name"}
        data = {key: data[key] for key in data.keys() - own} | {"remesh": None, "damage": None}
    merged = OmegaConf.to_container(OmegaConf.merge(data, given))
    return read_stored_config(trained.model_dump() | {"data": merged}, "this evaluation")


def check_random(key: str, count: int, config: TrainConfig, least: int) -> None:
    """Raise ConfigError if repetitions are requested of a network without random neighbourhoods.

    Args:
        key: The setting, for the message.
        count: Its value.
        config: The config of the network.
        least: The value that requests none.
    """
    neighbourhood = Neighbourhood.of(config.neighbourhood)
    if count > least and not neighbourhood.random:
        raise ConfigError(
            f"{key} must be {least} for {config.model.name}, whose {neighbourhood.noun} are not "
            f"random, got {count}"
        )


def open_test_data(
    config: TrainConfig, template: Mesh, requested: dict[str, Any]
) -> CorrespondenceData:
    """The data set of a config, with its test shapes prepared.

    Args:
        config: From `config_on_data`.
        template: The template that the run was trained on.
        requested: The data settings that the user gave.

    Raises:
        RunError: The data set has another template.
        DataError, MeshError: The data set cannot be used.
    """
    try:
        data = open_data(config)
    except DataError as error:
        if "name" in requested:
            raise
        raise DataError(f"{error}; if the data set has moved, add data.root=") from error
    theirs = data.shapes.template
    if not (
        np.array_equal(template.vertices, theirs.vertices)
        and np.array_equal(template.faces, theirs.faces)
    ):
        raise RunError(
            f"data {config.data.name} must have the template of the run, which has "
            f"{len(template.vertices)} vertices; got another template, of {data.num_classes}"
        )
    data.prepare(["test"])
    return data


def choose_shapes(shapes: int | list[str], names: list[str]) -> list[str]:
    """The test shapes to draw.

    Args:
        shapes: How many, spread evenly over the test set; or their names.
        names: Names of all test shapes.

    Raises:
        ConfigError: There is no test shape of that name.
    """
    if isinstance(shapes, int):
        return evenly(names, shapes) if shapes else []
    if unknown := [name for name in shapes if name not in names]:
        known = ", ".join(names)
        raise ConfigError(f"shapes must be among the test shapes ({known}), got {unknown[0]}")
    return shapes


def evaluate(predict: Predict, data: CorrespondenceData) -> Outcome:
    """Predict all test shapes as `train` does."""
    names, items = data.shapes.names["test"], data.datasets["test"]
    progress = Progress(range(len(items)), desc="Test", unit="mesh", leave=False, delay=1.0)
    results = {i: predict_mesh(predict, data, i, "evaluation") for i in progress}
    return Outcome.of(names, items, results, data.reference.diameter)


def evaluate_rotations(predict: Predict, data: CorrespondenceData, count: int) -> Rotations:
    """Predict all test shapes `count` times, each time with other random neighbourhoods."""
    items = data.datasets["test"]
    progress = Progress(range(count), desc="Rotations", unit="run")
    runs = (
        [predict_mesh(predict, data, i, f"rotation {r}") for i in range(len(items))]
        for r in progress
    )
    return rotations(runs, [item["labels"].numpy() for item in items])


def evaluate_points(
    predict: PredictDistributions, data: CorrespondenceData, predicted: Outcome
) -> np.ndarray:
    """Predict points within faces instead of vertices, for all test shapes.

    A point is the mean of the template's vertices around the predicted one, by their probabilities,
    moved to the nearest point of the surface.

    Args:
        predict: With the network that predicted the outcome.
        data: The data set.
        predicted: From `evaluate`.

    Returns:
        Distances from the true points over sqrt(area), float64 [K], in the order of the outcome.
    """
    template, errors = data.shapes.template, []
    near = near_vertices(template, SPREAD)
    progress = Progress(predicted.names, desc="Points", unit="mesh", leave=False, delay=1.0)
    for batch, name in zip(data.datasets["test"], progress, strict=True):
        labels = predicted.predicted[predicted.mesh(name)]
        points = soft_points(predict(batch, "evaluation"), labels, near, template.vertices)
        face, weights, _ = closest_points(template, points, np.full_like(points, np.nan))
        found = SurfacePoints(template.faces[face], weights)
        true = true_points(batch)
        errors.append(point_errors(found, true, data.reference, data.reference.place))
    return np.concatenate(errors)


def predict_mesh(predict: Predict, data: CorrespondenceData, i: int, purpose: str) -> Result:
    """Prediction and errors of test mesh i; random neighbourhoods depend on the purpose."""
    batch = data.datasets["test"][i]
    classes = predict(batch, purpose).classes.cpu().numpy()
    return result_of(classes, batch, data.reference)


def create_folder(
    run: Path,
    config: TrainConfig,
    trained: TrainConfig,
    votes: int = 1,
) -> Path:
    """Create the folder of an evaluation, or remove the plots of an earlier one.

    Args:
        run: The run folder.
        config: From `config_on_data`.
        trained: The config of the run.
        votes: Number of draws that vote.

    Returns:
        <run>/evaluation/<name of the data set>; with a hash of its settings if they are not the
        run's own, and with the number of votes if there are several.
    """
    data, own = (c.data.model_dump(exclude=SAME) for c in (config, trained))
    name = config.data.name
    if data != own:
        name += f"-{digest(json.dumps(data, sort_keys=True))[:8]}"
    if votes > 1:
        name += f"-votes{votes}"
    folder = run / "evaluation" / name
    folder.mkdir(parents=True, exist_ok=True)
    for plot in PLOTS:
        (folder / plot).unlink(missing_ok=True)
    return folder


def point_metrics(errors: np.ndarray) -> tuple[dict[str, float], np.ndarray]:
    """Pool the errors of points: metrics for metrics.json, without "points/", and the curve."""
    pooled = CorrespondenceError()
    pooled.update(errors, errors == 0)
    values = pooled.compute()
    curve = values.pop("curve").numpy()
    del values["exact_match"]  # a point hardly ever is the true one
    return {name: float(value) for name, value in values.items()}, curve


def write_rotations(folder: Path, found: Rotations) -> None:
    """Write the plot of all repetitions, rotations.<kind>."""
    figure = all_curves_figure(THRESHOLDS, found.curves)
    for kind in KINDS:
        write_file(folder / f"rotations.{kind}", encoded(figure, kind))


def point_lines(metrics: dict[str, float]) -> list[str]:
    """The metrics of points, for the log."""
    return [
        "Points within faces instead of vertices",
        f"  within 0.05 sqrt(area)             {100 * metrics['within_0.05']:7.2f} %",
        f"  mean geodesic error / sqrt(area)   {metrics['geodesic_error']:9.4f}",
    ]


def rotation_lines(found: Rotations) -> list[str]:
    """The metrics of all repetitions, for the log."""
    exact, error = 100 * found.exact_match, found.geodesic_error
    return [
        f"{len(exact)} repetitions, each with other random neighbourhoods",
        f"  exact match          {exact.mean():7.2f} % (standard deviation {exact.std():.2f}, "
        f"{exact.min():.2f} to {exact.max():.2f})",
        f"  mean geodesic error  {error.mean():9.4f} (standard deviation {error.std():.4f}, "
        f"{error.min():.4f} to {error.max():.4f})",
        f"  same prediction in all repetitions: {100 * found.unchanged:.2f} % of the vertices",
    ]
