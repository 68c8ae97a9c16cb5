"""Tables of finished runs: for a page, as CSV, for LaTeX."""

from __future__ import annotations

import csv
import io
from typing import Any

import numpy as np

from meshspiral.reporting.groups import FIGURES, Group, other_settings, plain


def run_table(groups: list[Group]) -> tuple[list[str], list[list[Any]]]:
    """Names of columns, and a row for each run."""
    others = other_settings(groups)
    columns = ["network", "N", "metric", "data", "seed", *others, *FIGURES.values(), "folder"]
    rows = []
    for group in groups:
        for run in group.runs:
            rows.append(
                [
                    *described(group),
                    run.config["seed"],
                    *(dict(group.others).get(key) for key in others),
                    *(run.figure(key) for key in FIGURES),
                    str(run.folder),
                ]
            )
    return columns, rows


def described(group: Group) -> list[Any]:
    length = group.length and group.length.removeprefix("N = ")
    return [group.network, length, group.metric, group.data]


def as_csv(columns: list[str], rows: list[list[Any]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([columns, *rows])
    return text.getvalue()


def group_table(groups: list[Group]) -> tuple[list[str], list[list[str]]]:
    """Names of columns, and a row of texts for each group: mean and spread where it has several
    seeds."""
    others = other_settings(groups)
    columns = ["network", "N", "metric", "data", "seeds", *others, *FIGURES.values()]
    rows = []
    for group in groups:
        cells = [*described(group), len(group.seeds), *(dict(group.others).get(k) for k in others)]
        figures = [spread([run.figure(key) for run in group.runs], key) for key in FIGURES]
        rows.append([*map(plain, cells), *figures])
    return columns, rows


def as_markdown(columns: list[str], rows: list[list[str]]) -> str:
    lines = columns, ["---"] * len(columns), *rows
    return "".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |\n" for line in lines)


def as_tex(columns: list[str], rows: list[list[str]]) -> str:
    """A table for booktabs."""
    sides = "".join("r" if column in FIGURES.values() else "l" for column in columns)
    first, *others = (" & ".join(map(escaped, row)) + r" \\" for row in (columns, *rows))
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


def spread(values: list[float], key: str) -> str:
    """The mean, and the standard deviation of several seeds (over their number), as a reader wants
    them; a dash where one has no such figure."""
    if key == "parameters":
        return f"{values[0]:,.0f}"
    digits = 1 if "%" in FIGURES[key] else 0 if key.startswith("seconds") else 4
    several = f" ± {np.std(values):.{digits}f}" if len(values) > 1 else ""
    if np.isnan(values).any():
        return "\u2013"
    return f"{np.mean(values):.{digits}f}{several}"


def escaped(text: str) -> str:
    named = {
        "\\": r"\textbackslash ",
        "^": r"\textasciicircum ",
        "~": r"\textasciitilde ",
        "±": r"$\pm$",
        "\u2013": "--",
    }
    return "".join(named.get(c, "\\" + c if c in "_%&#${}" else c) for c in text)
