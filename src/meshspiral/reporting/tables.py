"""Tables of runs and groups: rows of cells, and their CSV, Markdown and LaTeX."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np

from meshspiral.data.files import write_file
from meshspiral.reporting.groups import Group, format_value, other_keys
from meshspiral.reporting.runs import Run

# column headings of metrics; "%" marks a share that is shown in per cent
METRIC_COLUMNS = {
    "test/exact_match": "exact match (%)",
    "test/geodesic_error": "mean error",
    "test/within_0.05": "within 0.05 (%)",
    "val/exact_match": "validation: exact match (%)",
    "parameters": "parameters",
    "seconds/train": "seconds of training",
    "epochs/to_90_percent": "epochs to 0.9 of its best validation",
}


def write_tables(groups: list[Group], folder: Path) -> None:
    """Write table.csv, one row a run, and table.tex and table.md, one row a group."""
    write_file(folder / "table.csv", csv_text(*run_table(groups)))
    write_file(folder / "table.tex", latex_text(*group_table(groups)))
    write_file(folder / "table.md", markdown_text(*group_table(groups)))


def run_table(groups: list[Group]) -> tuple[list[str], list[list[Any]]]:
    """Column headings, and one row of values for each run."""
    others = other_keys(groups)
    columns = ["network", "N", "metric", "data", "seed", *others]
    columns += [*METRIC_COLUMNS.values(), "folder"]
    rows = []
    for group in groups:
        for run in group.runs:
            rows.append(
                [
                    *attribute_cells(group),
                    run.config.seed,
                    *(dict(group.others).get(key) for key in others),
                    *(metric_value(run, key) for key in METRIC_COLUMNS),
                    str(run.folder),
                ]
            )
    return columns, rows


def group_table(groups: list[Group]) -> tuple[list[str], list[list[str]]]:
    """Column headings, and one row of texts for each group: metrics as `format_metric` has them."""
    others = other_keys(groups)
    columns = ["network", "N", "metric", "data", "seeds", *others, *METRIC_COLUMNS.values()]
    rows = []
    for group in groups:
        cells = [*attribute_cells(group), len(group.seeds)]
        cells += [dict(group.others).get(key) for key in others]
        metrics = [
            format_metric([metric_value(run, key) for run in group.runs], key, len(group.seeds) > 1)
            for key in METRIC_COLUMNS
        ]
        rows.append([*map(format_value, cells), *metrics])
    return columns, rows


def attribute_cells(group: Group) -> list[Any]:
    """The first four cells of a row: network, length, metric information and data set."""
    length = group.length and group.length.removeprefix("N = ")
    return [group.network, length, group.metric, group.data]


def metric_value(run: Run, key: str) -> float:
    """A metric in the unit of its column; NaN if the run lacks it."""
    value = run.metrics.get(key, float("nan"))
    return 100 * value if "%" in METRIC_COLUMNS[key] else value


def format_metric(values: list[float], key: str, deviates: bool = False) -> str:
    """A metric as text.

    Args:
        values: One value for each run, in the unit of the column.
        key: Key of `METRIC_COLUMNS`.
        deviates: Whether the runs differ in the seed, so that their deviation has a meaning.

    Returns:
        The mean, and with `deviates` the population standard deviation; a dash if a run lacks the
        metric.
    """
    if key == "parameters":
        return f"{values[0]:,.0f}"
    digits = 1 if "%" in METRIC_COLUMNS[key] else 0 if key.startswith(("seconds", "epochs")) else 4
    deviation = f" ± {np.std(values):.{digits}f}" if deviates else ""
    if np.isnan(values).any():
        return "\u2013"
    return f"{np.mean(values):.{digits}f}{deviation}"


def csv_text(columns: list[str], rows: list[list[Any]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([columns, *rows])
    return text.getvalue()


def markdown_text(columns: list[str], rows: list[list[str]]) -> str:
    lines = columns, ["---"] * len(columns), *rows
    return "".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |\n" for line in lines)


def latex_text(columns: list[str], rows: list[list[str]]) -> str:
    """A LaTeX table; needs the package booktabs."""
    sides = "".join("r" if column in METRIC_COLUMNS.values() else "l" for column in columns)
    first, *others = (" & ".join(map(escape_latex, row)) + r" \\" for row in (columns, *rows))
    return "\n".join(
        [
            rf"\begin{{tabular}}{{{sides}}}",
            r"\toprule",
            first,
            r"\midrule",
            *others,
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )


def escape_latex(text: str) -> str:
    """Text in which LaTeX gives no character a meaning."""
    named = {
        "\\": r"\textbackslash ",
        "^": r"\textasciicircum ",
        "~": r"\textasciitilde ",
        "±": r"$\pm$",
        "\u2013": "--",
    }
    return "".join(named.get(c, "\\" + c if c in "_%&#${}" else c) for c in text)
