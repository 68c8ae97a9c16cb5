"""What a test shows: a table of its figures, curves, pictures."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from tqdm import tqdm

from meshspiral.data.datamodule import CorrespondenceData
from meshspiral.evaluation.metrics import THRESHOLDS
from meshspiral.evaluation.outcome import Outcome
from meshspiral.experiment.runs import write_whole
from meshspiral.viz.plots import (
    curve_figure,
    encoded,
    error_colors,
    picture_figure,
    template_colors,
)
from meshspiral.viz.render import RenderError, Row, render

log = logging.getLogger(__name__)


def table(outcome: Outcome, metrics: Mapping[str, float]) -> list[str]:
    """The test figures of metrics.json, in lines."""
    names = outcome.names
    shares = {"exact match": "exact_match"}
    shares |= {f"within {r} sqrt(area)": f"within_{r}" for r in ("0.01", "0.05", "0.10")}
    errors = {
        "mean geodesic error / sqrt(area)": "geodesic_error",
        "mean geodesic error / diameter": "geodesic_error_diameter",
    }
    return [
        f"Test on {len(names)} unseen meshes ({names[0]} .. {names[-1]}), "
        f"{len(outcome.labels):,} vertices",
        *(f"  {what:<34} {100 * metrics['test/' + key]:7.2f} %" for what, key in shares.items()),
        *(f"  {what:<34} {metrics['test/' + key]:9.4f}" for what, key in errors.items()),
    ]


def draw(
    folder: Path,
    curves: Mapping[str, np.ndarray],
    outcome: Outcome,
    data: CorrespondenceData,
    chosen: list[str],
    kinds: tuple[str, ...] = ("png",),
) -> None:
    """Write curve.<kind> and, for the chosen test shapes, correspondence.png and errors.png.

    curves: by name, over THRESHOLDS. Without an OpenGL library a warning takes the renders' place.
    """
    figure = curve_figure({name: (THRESHOLDS, curve) for name, curve in curves.items()})
    for kind in kinds:
        write_whole(folder / f"curve.{kind}", encoded(figure, kind))
    if not chosen:
        return
    rows = [correspondence_row(outcome, data, chosen), error_row(outcome, data, chosen)]
    try:
        with tqdm(total=1, desc="Pictures", leave=False, delay=1.0):
            drawn = render(rows, data.shapes.up)
    except RenderError as error:
        log.warning("no pictures of the shapes: %s", error)
        return
    figures = {
        "correspondence.png": picture_figure(*drawn[0], ["template", *chosen]),
        "errors.png": picture_figure(*drawn[1], chosen, bar="error"),
    }
    for name, picture in figures.items():
        write_whole(folder / name, encoded(picture, "png"))


def correspondence_row(outcome: Outcome, data: CorrespondenceData, chosen: list[str]) -> Row:
    """The template and test shapes, each vertex in the colour of its counterpart."""
    template = data.shapes.template
    colors = template_colors(template)
    meshes = [template, *(data.shape(name).mesh for name in chosen)]
    return Row(meshes, [colors, *(colors[outcome.predicted[outcome.mesh(n)]] for n in chosen)])


def error_row(outcome: Outcome, data: CorrespondenceData, chosen: list[str]) -> Row:
    """Test shapes, each vertex in the colour of its geodesic error."""
    meshes = [data.shape(name).mesh for name in chosen]
    return Row(meshes, [error_colors(outcome.errors[outcome.mesh(name)]) for name in chosen])
