"""Tables of finished runs: for a page, as CSV, for LaTeX."""

from __future__ import annotations

import csv
import io
from typing import Any

import numpy as np

from src.comparison import FIGURES, Group, other_settings, plain


def run_table(groups: list[Group]) -> tuple[list[str], list[list[Any]]]:
    """Names of columns, and a row for each run."""
    others = other_settings(groups)
    columns = ["network", "N", "metric", "data", "seed", *others, *FIGURES.values(), "folder"]
    rows = []
    for group in groups:
        for run in group.runs:
            rows.append([*described(group), run.config["seed"],
                         *(dict(group.others).get(key) for key in others),
                         *(run.figure(key) for key in FIGURES), str(run.folder)])  # fmt: skip
    return columns, rows


def described(group: Group) -> list[Any]:
    length = group.length and group.length.removeprefix("N = ")
    return [group.network, length, group.metric, group.data]


def as_csv(columns: list[str], rows: list[list[Any]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([columns, *rows])
    return text.getvalue()


def as_tex(groups: list[Group]) -> str:
    """A table for booktabs: a row for each group, mean and spread where it has several seeds."""
    others = other_settings(groups)
    shown = [key for key in FIGURES if key.startswith("test/") or key == "parameters"]
    columns = ["network", "$N$", "metric", "data", *map(escaped, others),
               *(escaped(FIGURES[key]) for key in shown)]  # fmt: skip
    lines = [rf"\begin{{tabular}}{{{'l' * (4 + len(others))}{'r' * len(shown)}}}", r"\toprule",
             " & ".join(columns) + r" \\", r"\midrule"]  # fmt: skip
    for group in groups:
        cells = [*described(group), *(dict(group.others).get(key) for key in others)]
        texts = ["--" if cell is None else escaped(plain(cell)) for cell in cells]
        texts += [
            spread([run.figure(key) for run in group.runs], key).replace("±", r"$\pm$")
            for key in shown
        ]
        lines.append(" & ".join(texts) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


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
    named = {"\\": r"\textbackslash ", "^": r"\textasciicircum ", "~": r"\textasciitilde "}
    return "".join(named.get(c, "\\" + c if c in "_%&#${}" else c) for c in text)
