"""Test shapes for the 3D view of a report's page."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from meshspiral.data.datamodule import CorrespondenceData
from meshspiral.data.progress import Progress
from meshspiral.data.shapes import DataError
from meshspiral.data.sources import open_data
from meshspiral.evaluation.outcome import Outcome, evenly
from meshspiral.geometry.digest import digest
from meshspiral.geometry.mesh import Mesh, MeshError
from meshspiral.reporting.runs import Run
from meshspiral.viz.colors import MOST_ERROR, template_colors
from meshspiral.viz.pages import pack_array
from meshspiral.viz.render import upright


class Scenes:
    """Test shapes with predictions and errors, as JSON.

    Attributes:
        scenes: One entry for each run and shape, in which surfaces are indices into `surfaces`.
        surfaces: Meshes with the colours of their vertices; equal ones are stored once.
    """

    def __init__(self) -> None:
        self.scenes: list[dict[str, Any]] = []
        self.surfaces: list[dict[str, str]] = []
        self._indices: dict[str, int] = {}

    def add_shape(
        self, run: str, name: str, mesh: Mesh, data: CorrespondenceData, outcome: Outcome
    ) -> None:
        """Add a test shape and its template.

        Args:
            run: Name of the run on the page.
            name: Name of the shape.
            mesh: Its mesh.
            data: The run's data set.
            outcome: The run's predictions and errors.
        """
        part, template = outcome.mesh(name), data.shapes.template
        errors = np.minimum(outcome.errors[part] / MOST_ERROR, 1)
        self.scenes.append(
            {
                "run": run,
                "name": name,
                "template": self._add_surface(template, data.shapes.up),
                "shape": self._add_surface(mesh, data.shapes.up),
                "predicted": pack_array(outcome.predicted[part], np.int32),
                "labels": pack_array(outcome.labels[part], np.int32),
                "errors": pack_array(np.round(255 * errors), np.uint8),
            }
        )

    def _add_surface(self, mesh: Mesh, up: str) -> int:
        """Add a mesh unless it is there; returns its index."""
        points = upright(mesh.vertices, up)
        points = points - (points.min(axis=0) + points.max(axis=0)) / 2
        colors = np.round(255 * template_colors(mesh))
        surface = {
            "points": pack_array(points.T, np.float32),
            "faces": pack_array(mesh.faces.T, np.int32),
            "colors": pack_array(colors, np.uint8),
        }
        index = self._indices.setdefault(digest(*surface.values()), len(self.surfaces))
        if index == len(self.surfaces):
            self.surfaces.append(surface)
        return index


def scenes_of(runs: list[Run], count: int) -> tuple[Scenes, list[str]]:
    """Test shapes of all runs.

    Args:
        runs: The runs; each is named by its path below their common folder.
        count: Number of shapes of each run, spread evenly over its test set.

    Returns:
        The scenes; and one line for each run whose shapes are not available.
    """
    scenes, notes = Scenes(), []
    root = Path(os.path.commonpath([run.folder.parent for run in runs]))
    for run in Progress(runs if count else [], desc="Shapes", leave=False, delay=1.0):
        try:
            data = open_data(run.config)
            for name in evenly(run.outcome.names, count):
                shape = data.shape(name)
                if not np.array_equal(shape.labels, run.outcome.labels[run.outcome.mesh(name)]):
                    raise DataError(f"{name} has changed since the test: other vertices or labels")
                run_name = str(run.folder.relative_to(root))
                scenes.add_shape(run_name, name, shape.mesh, data, run.outcome)
        except (DataError, MeshError, OSError) as error:
            notes.append(f"{run.folder}: cannot show its shapes ({error})")
    return scenes, notes
