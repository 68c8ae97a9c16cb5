"""What a finished run shows: a table of its figures, a curve, a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from src.correspondence import Correspondence
from src.data.datamodule import CorrespondenceData
from src.figures import curve_figure, render_row, template_colors
from src.metrics import THRESHOLDS


def table(folder: Path, data: CorrespondenceData, metrics: dict[str, float]) -> str:
    """The test figures of metrics.json, and where to look further."""
    names = data.shapes.names["test"]
    vertices = sum(len(item["labels"]) for item in data.datasets["test"].items)
    shares = {"exact match": "exact_match"}
    shares |= {f"within {r} sqrt(area)": f"within_{r}" for r in ("0.01", "0.05", "0.10")}
    errors = {"mean geodesic error / sqrt(area)": "geodesic_error",
              "mean geodesic error / diameter": "geodesic_error_diameter"}  # fmt: skip
    return "\n".join([
        f"Test on {len(names)} unseen meshes ({names[0]} .. {names[-1]}), {vertices:,} vertices",
        *(f"  {what:<34} {100 * metrics['test/' + key]:7.2f} %" for what, key in shares.items()),
        *(f"  {what:<34} {metrics['test/' + key]:9.4f}" for what, key in errors.items()),
        f"Seconds:     {metrics['seconds/preprocess']:.1f} preprocessing, "
        f"{metrics['seconds/train']:.1f} training",
        f"Run folder:  {folder}",
        f"TensorBoard: tensorboard --logdir {folder}",
    ])  # fmt: skip


def draw_curve(path: Path, module: Correspondence) -> None:
    """The curve of correct matches, of validation and test."""
    curves = {split: (THRESHOLDS, curve) for split, curve in module.curves.items()}
    curve_figure(curves).savefig(path, dpi=150)


def draw_shapes(path: Path, data: CorrespondenceData, predictions: dict[int, np.ndarray]) -> None:
    """The template and up to four test shapes, each vertex in the colour of its counterpart.

    predictions: by number of the test mesh, int64 [V]. Errors: RenderError.
    """
    names, template = data.shapes.names["test"], data.shapes.template
    colors = template_colors(template)
    there = sorted(predictions)  # not all, where several devices shared the test
    chosen = [there[i] for i in np.unique(np.linspace(0, len(there) - 1, 4).round().astype(int))]
    render_row(
        path,
        [template, *(data.shape(names[i]).mesh for i in chosen)],
        [colors, *(colors[predictions[i]] for i in chosen)],
        ["template", *(names[i] for i in chosen)],
        data.shapes.up,
    )
