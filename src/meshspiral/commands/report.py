"""One page of many runs, to look through and print from: `python -m src.report runs=<folder>`."""

from __future__ import annotations

import logging
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from omegaconf import DictConfig
from tqdm import tqdm

from meshspiral.data.cache import digest
from meshspiral.data.shapes import DataError
from meshspiral.experiment.entry import entry_point
from meshspiral.experiment.runs import write_whole
from meshspiral.experiment.schema import ConfigError, typed
from meshspiral.geometry.mesh import MeshError

log = logging.getLogger(__name__)


@dataclass
class Report:
    runs: str | None = None
    output: str | None = None
    shapes: int = 4


def check(config: DictConfig) -> DictConfig:
    found = typed(config, Report)
    if not found.runs:
        raise ConfigError("runs= is missing: a folder with runs, or a pattern: 'outputs/*/*_fcs'")
    if found.shapes < 0:
        raise ConfigError(f"shapes must be at least 0; got {found.shapes}")
    return found


@entry_point("report", check)
def main(config: DictConfig) -> None:
    folder = report(config)
    log.info("Report:  %s", folder / "index.html")


def report(config: DictConfig) -> Path:
    """Write the page, its figures and tables. Returns their folder."""
    from meshspiral.evaluation.metrics import THRESHOLDS
    from meshspiral.reporting.groups import arrangements, collect, grouped
    from meshspiral.reporting.page import page
    from meshspiral.reporting.tables import as_csv, as_markdown, as_tex, group_table, run_table
    from meshspiral.viz.plots import curve_figure, encoded

    runs, broken = collect(config.runs)
    for _, reason in broken:
        log.warning("left out: %s", reason)
    groups = grouped(runs)
    folder = Path(config.output) if config.output else beside(config.runs) / "report"
    folder.mkdir(parents=True, exist_ok=True)

    figures = dict(arrangements(groups))
    drawn = {}
    for title, curves in tqdm(figures.items(), desc="Curves", leave=False, delay=1.0):
        figure = curve_figure({name: (THRESHOLDS, several) for name, several in curves.items()})
        svg = encoded(figure, "svg").decode()
        drawn[title] = svg[svg.index("<svg") :]
        for kind in ("pdf", "png"):
            write_whole(folder / f"{file_name(title)}.{kind}", encoded(figure, kind))
    write_whole(folder / "table.csv", as_csv(*run_table(groups)))
    of_groups = group_table(groups)
    write_whole(folder / "table.tex", as_tex(*of_groups))
    write_whole(folder / "table.md", as_markdown(*of_groups))
    scenes, notes = looks(runs, config.shapes)
    for group in groups:
        if len(group.seeds) < len(group.runs):
            notes.append(f"{group.label()}: a seed was run more than once")
    for note in notes:
        log.warning("%s", note)
    write_whole(folder / "index.html", page(groups, broken, drawn, scenes, notes))
    log.info("%d runs, %d left out", len(runs), len(broken))
    return folder


def file_name(title: str) -> str:
    name = re.sub(r"[^a-z0-9]+", "-", title.lower().replace("++", " metric")).strip("-")
    return name if len(name) <= 100 else f"{name[:100]}-{digest(title)[:8]}"


def beside(runs: str) -> Path:
    """The folder that a pattern's places lie in, or the folder itself."""
    if Path(runs).is_dir():
        return Path(runs)
    parts = Path(runs).parts
    plain = next((i for i, part in enumerate(parts) if re.search(r"[*?\[]", part)), len(parts))
    return Path(*parts[:plain])


def looks(runs: list, count: int):
    """The 3D views of so many shapes of each run; and what is missing, in lines."""
    from meshspiral.data.sources import open_data
    from meshspiral.evaluation.outcome import evenly
    from meshspiral.reporting.page import Scenes

    scenes, notes = Scenes(), []
    above = Path(os.path.commonpath([run.folder.parent for run in runs]))
    for run in tqdm(runs if count else [], desc="Shapes", leave=False, delay=1.0):
        try:
            data = open_data(run.config)
            for name in evenly(run.outcome.names, count):
                shape = data.shape(name)
                if not np.array_equal(shape.labels, run.outcome.labels[run.outcome.mesh(name)]):
                    raise DataError(f"{name} has changed since: other vertices, or other labels")
                scenes.add(str(run.folder.relative_to(above)), name, shape.mesh, data, run.outcome)
        except (DataError, MeshError, OSError) as error:
            notes.append(f"{run.folder}: no view of its shapes ({error})")
    return scenes, notes


if __name__ == "__main__":
    main()
