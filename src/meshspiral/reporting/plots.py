"""Plots that compare groups of runs, as the paper's figures do."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from meshspiral.data.files import write_file
from meshspiral.data.progress import Progress
from meshspiral.evaluation.metrics import THRESHOLDS
from meshspiral.geometry.digest import digest
from meshspiral.reporting.groups import Group, other_keys
from meshspiral.viz.plots import curve_figure, encoded


def write_plots(groups: list[Group], folder: Path) -> dict[str, str]:
    """Write each comparison as PDF and PNG.

    Returns:
        The plots as SVG elements, by title.
    """
    plots = {}
    comparisons = dict(compared_curves(groups))
    for title, curves in Progress(comparisons.items(), desc="Curves", leave=False, delay=1.0):
        figure = curve_figure({name: (THRESHOLDS, several) for name, several in curves.items()})
        svg = encoded(figure, "svg").decode()
        plots[title] = svg[svg.index("<svg") :]
        for kind in ("pdf", "png"):
            write_file(folder / f"{file_name(title)}.{kind}", encoded(figure, kind))
    return plots


def compared_curves(groups: list[Group]) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """All groups in one comparison, then the comparisons of the paper.

    These are: networks at one length, lengths of one network, and one network with and without
    metric information. Each needs at least two groups.

    Yields:
        A title, and the groups' curves [R, T] by label.
    """
    yield "All runs", labelled_curves(groups)
    sequential = [group for group in groups if group.length]
    for data, length, metric in dict.fromkeys((g.data, g.length, g.metric) for g in sequential):
        here = [g for g in sequential if (g.data, g.length, g.metric) == (data, length, metric)]
        here += [g for g in groups if g.data == data and not g.length]
        if len({g.network for g in here}) > 1:
            how = {True: " with metric information", False: " without metric information"}
            title = f"Networks at {length}{how.get(metric, '')}, {data}"
            yield title, labelled_curves(here, "length", "data", "metric")
    for here in equal_but_for("length", groups):
        title = f"Lengths of {here[0].label('length')}"
        yield title, labelled_curves(here, "network", "metric")
    for here in equal_but_for("metric", groups):
        title = f"Metric information: {here[0].label('metric')}"
        yield title, labelled_curves(here, "network", "length", "data")


def equal_but_for(attribute: str, groups: list[Group]) -> list[list[Group]]:
    """Sets of at least two groups that are equal in all attributes but one."""
    others = [a for a in ("network", "data", "length", "metric", "others") if a != attribute]
    found: dict[str, list[Group]] = {}
    for group in groups:
        found.setdefault(json.dumps([getattr(group, a) for a in others]), []).append(group)
    return [several for several in found.values() if len(several) > 1]


def labelled_curves(groups: list[Group], *omit: str) -> dict[str, np.ndarray]:
    """Curves [R, T] by labels that show only what differs between the groups.

    Args:
        groups: The groups of one plot.
        *omit: What the plot's title already says, see `Group.label`.
    """
    for key in other_keys(groups):
        if len({json.dumps(dict(group.others).get(key)) for group in groups}) == 1:
            omit += (key,)
    for attribute in ("data", "length"):
        if len({getattr(group, attribute) for group in groups}) == 1:
            omit += (attribute,)
    return {group.label(*omit): group.curves for group in groups}


def file_name(title: str) -> str:
    """The file name of a plot, without extension: short, and different for different titles."""
    name = re.sub(r"[^a-z0-9]+", "-", title.lower().replace("++", " metric")).strip("-")
    return name if len(name) <= 100 else f"{name[:100]}-{digest(title)[:8]}"
