"""The summary of a test: its metrics as text, curves and renders."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from meshspiral.data.datamodule import CorrespondenceData
from meshspiral.data.files import write_file
from meshspiral.data.progress import Progress
from meshspiral.evaluation.metrics import THRESHOLDS
from meshspiral.evaluation.outcome import Outcome
from meshspiral.viz.colors import error_colors, template_colors
from meshspiral.viz.plots import curve_figure, encoded, picture_figure
from meshspiral.viz.render import RenderError, Row, render

log = logging.getLogger(__name__)


def metric_lines(outcome: Outcome, metrics: Mapping[str, float]) -> list[str]:
    """The test metrics as lines of text.

    Args:
        outcome: Of the test.
        metrics: The content of metrics.json.
    """
    names = outcome.names
    shares = {"exact match": "exact_match"}
    shares |= {f"within {r} sqrt(area)": f"within_{r}" for r in ("0.01", "0.05", "0.10")}
    errors = {
        "mean geodesic error / sqrt(area)": "geodesic_error",
        "mean geodesic error / diameter": "geodesic_error_diameter",
        "mean error to the labelled vertex": "geodesic_error_to_label",
    }
    errors = {title: key for title, key in errors.items() if f"test/{key}" in metrics}
    return [
        f"Test on {len(names)} unseen meshes ({names[0]} .. {names[-1]}), "
        f"{len(outcome.labels):,} vertices",
        *(f"  {title:<34} {100 * metrics['test/' + key]:7.2f} %" for title, key in shares.items()),
        *(f"  {title:<34} {metrics['test/' + key]:9.4f}" for title, key in errors.items()),
    ]


def write_plots(
    folder: Path,
    curves: Mapping[str, np.ndarray],
    outcome: Outcome,
    data: CorrespondenceData,
    chosen: list[str],
    kinds: tuple[str, ...] = ("png",),
) -> None:
    """Write curve.<kind>, and renders of test shapes: correspondence.png and errors.png.

    Without an OpenGL library, a warning says that the renders are skipped.

    Args:
        folder: Where to write them.
        curves: By name, the shares of correct matches over THRESHOLDS.
        outcome: Of the test.
        data: The data set, with the test split prepared.
        chosen: Names of the test shapes to render; none for no renders.
        kinds: File formats of the curves: "png", "pdf", "svg".
    """
    figure = curve_figure({name: (THRESHOLDS, curve) for name, curve in curves.items()})
    for kind in kinds:
        write_file(folder / f"curve.{kind}", encoded(figure, kind))
    if not chosen:
        return
    rows = [correspondence_row(outcome, data, chosen), error_row(outcome, data, chosen)]
    try:
        with Progress(total=1, desc="Rendering", leave=False, delay=1.0):
            correspondence, errors = render(rows, data.shapes.up)
    except RenderError as error:
        log.warning("skipping renders: %s", error)
        return
    figures = {
        "correspondence": picture_figure(*correspondence, ["template", *chosen]),
        "errors": picture_figure(*errors, chosen, bar="error"),
    }
    for name, picture in figures.items():
        write_file(folder / f"{name}.png", encoded(picture, "png"))


def correspondence_row(outcome: Outcome, data: CorrespondenceData, chosen: list[str]) -> Row:
    """The template and test shapes, each vertex in the colour of its predicted counterpart."""
    template = data.shapes.template
    colors = template_colors(template)
    meshes = [template, *(data.shape(name).mesh for name in chosen)]
    return Row(meshes, [colors, *(colors[outcome.predicted[outcome.mesh(n)]] for n in chosen)])


def error_row(outcome: Outcome, data: CorrespondenceData, chosen: list[str]) -> Row:
    """Test shapes, each vertex in the colour of its geodesic error."""
    meshes = [data.shape(name).mesh for name in chosen]
    return Row(meshes, [error_colors(outcome.errors[outcome.mesh(name)]) for name in chosen])
