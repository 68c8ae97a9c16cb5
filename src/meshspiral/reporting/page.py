"""The page of a report: one HTML file that needs no network."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from plotly.offline import get_plotlyjs

from meshspiral.reporting.groups import Group, format_value, other_keys
from meshspiral.reporting.scenes import Scenes
from meshspiral.reporting.tables import METRIC_COLUMNS, format_metric, group_table, run_table
from meshspiral.viz.colors import ERROR_COLORS, MOST_ERROR
from meshspiral.viz.pages import fill_page, script_json

# columns that few readers need; a checkbox shows them, or the table would not fit a laptop's screen
RARE_KEYS = ("val/exact_match", "parameters", "seconds/train", "epochs/to_90_percent")
RARE = {METRIC_COLUMNS[key] for key in RARE_KEYS}
RARE |= {"folder"}
MOST_SETTINGS = 3  # columns of varied settings; more of them are rare too


def page_html(
    groups: list[Group],
    omitted: list[str],
    plots: Mapping[str, str],
    scenes: Scenes,
    notes: list[str],
) -> str:
    """The page.

    Args:
        groups: All groups.
        omitted: One line for each run that cannot be read.
        plots: SVG elements by title.
        scenes: Test shapes to show in 3D.
        notes: Warnings, one line each.
    """
    columns, rows = run_table(groups)
    seed_columns, group_rows = group_table(groups)
    rare = RARE | set(other_keys(groups)[MOST_SETTINGS:])
    scale = (255 * ERROR_COLORS(np.linspace(0, 1, 256))[:, :3]).round().astype(int).tolist()
    data = {"scenes": scenes.scenes, "surfaces": scenes.surfaces, "scale": scale}
    return fill_page(
        Path(__file__).with_name("page.html"),
        columns=columns,
        rare=rare,
        texts=["data", *other_keys(groups)],
        rare_names=[name for name in columns if name in rare],
        folders=[row[columns.index("folder")] for row in rows],
        rows=[[table_cell(*pair) for pair in zip(columns, row, strict=True)] for row in rows],
        seeds=[row for row, group in zip(group_rows, groups, strict=True) if len(group.seeds) > 1],
        seed_columns=seed_columns,
        omitted=omitted,
        plots=plots,
        notes=notes,
        runs=len(rows),
        scenes=len(scenes.scenes),
        max_error=MOST_ERROR,
        data=script_json(data),
        plotly=get_plotlyjs() if scenes.scenes else "",
    )


def table_cell(column: str, value: Any) -> dict[str, Any]:
    """The column and the text of a cell, and the value by which the column is sorted."""
    keys = {name: key for key, name in METRIC_COLUMNS.items()}
    text = format_metric([value], keys[column]) if column in keys else format_value(value)
    sort = value if isinstance(value, int | float) else str(value)
    return {"column": column, "text": text, "sort": sort}
