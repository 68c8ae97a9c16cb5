"""One HTML page of several runs, that opens without a network."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader
from plotly.offline import get_plotlyjs

from meshspiral.data.cache import digest
from meshspiral.data.datamodule import CorrespondenceData
from meshspiral.evaluation.outcome import Outcome
from meshspiral.geometry.mesh import Mesh
from meshspiral.reporting.groups import FIGURES, Group, plain
from meshspiral.reporting.tables import group_table, run_table, spread
from meshspiral.viz.plots import ERROR_COLORS, MOST_ERROR, template_colors
from meshspiral.viz.render import upright


def page(
    groups: list[Group],
    broken: list[tuple[Path, str]],
    curves: Mapping[str, str],
    scenes: Scenes,
    notes: list[str],
) -> str:
    """HTML. curves: by title, an SVG. notes: what a reader must know, in lines."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    columns, rows = run_table(groups)
    seed_columns, of_groups = group_table(groups)
    scale = (255 * ERROR_COLORS(np.linspace(0, 1, 256))[:, :3]).round().astype(int).tolist()
    data = json.dumps({"scenes": scenes.scenes, "surfaces": scenes.surfaces, "scale": scale})
    return environment.get_template("page.html").render(
        columns=columns,
        rows=[[cell(*pair) for pair in zip(columns, row, strict=True)] for row in rows],
        seeds=[row for row, group in zip(of_groups, groups, strict=True) if len(group.seeds) > 1],
        seed_columns=seed_columns,
        broken=broken,
        curves=curves,
        notes=notes,
        runs=len(rows),
        scenes=len(scenes.scenes),
        data=data.replace("<", "\\u003c"),
        plotly=get_plotlyjs() if scenes.scenes else "",
    )


def cell(column: str, value: Any) -> dict[str, Any]:
    """What a table shows, and what it sorts by."""
    keys = {name: key for key, name in FIGURES.items()}
    text = spread([value], keys[column]) if column in keys else plain(value)
    return {"text": text, "sort": value if isinstance(value, int | float) else str(value)}


class Scenes:
    """What the page's 3D view shows; a surface that several runs share stands in it once."""

    def __init__(self) -> None:
        self.scenes: list[dict[str, Any]] = []
        self.surfaces: list[dict[str, str]] = []
        self._places: dict[str, int] = {}

    def add(self, run: str, name: str, mesh: Mesh, data: CorrespondenceData, outcome: Outcome):
        """A test shape, as the run, so named on the page, predicted it, beside its template."""
        part, template = outcome.mesh(name), data.shapes.template
        errors = np.minimum(outcome.errors[part] / MOST_ERROR, 1)
        self.scenes.append(
            {
                "run": run,
                "name": name,
                "template": self._surface(template, data.shapes.up),
                "shape": self._surface(mesh, data.shapes.up),
                "predicted": packed(outcome.predicted[part], np.int32),
                "labels": packed(outcome.labels[part], np.int32),
                "errors": packed(np.round(255 * errors), np.uint8),
            }
        )

    def _surface(self, mesh: Mesh, up: str) -> int:
        points = upright(mesh.vertices, up)
        points = points - (points.min(axis=0) + points.max(axis=0)) / 2
        colors = np.round(255 * template_colors(mesh))
        surface = {
            "points": packed(points.T, np.float32),
            "faces": packed(mesh.faces.T, np.int32),
            "colors": packed(colors, np.uint8),
        }
        place = self._places.setdefault(digest(*surface.values()), len(self.surfaces))
        if place == len(self.surfaces):
            self.surfaces.append(surface)
        return place


def packed(array: np.ndarray, dtype: type) -> str:
    """Row by row, little-endian, in base64."""
    little = np.ascontiguousarray(array, dtype=np.dtype(dtype).newbyteorder("<"))
    return base64.b64encode(little.tobytes()).decode()
