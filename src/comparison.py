"""Finished runs side by side: what differs between them, their groups of seeds, tables."""

from __future__ import annotations

import csv
import glob
import io
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from src.config import flat
from src.evaluation import ERRORS, Outcome
from src.runs import CONFIG, METRICS, RunError, stored_config

# where and how a run was computed, or what its picture shows: not what was computed
BESIDE = ("trainer.", "data.cache_dir", "data.workers", "data.root", "picture", "resume", "metric")
NETWORKS = {"lstm": "LSTM-NET", "fcs": "FCS-NET", "gcnn3": "GCNN3"}
FIGURES = {
    "test/exact_match": "exact match (%)",
    "test/geodesic_error": "mean error",
    "test/within_0.05": "within 0.05 (%)",
    "val/exact_match": "validation: exact match (%)",
    "parameters": "parameters",
    "seconds/train": "seconds of training",
}


@dataclass(frozen=True, eq=False)
class Run:
    """A finished run: its folder, its whole config, what it measured."""

    folder: Path
    config: dict[str, Any]
    metrics: dict[str, float]
    outcome: Outcome
    curve: np.ndarray

    @property
    def settings(self) -> dict[str, Any]:
        """What was computed, by flat keys, without the seed."""
        keys = flat(self.config)
        if keys["model.name"] == "gcnn3":
            keys.pop("seq_len")  # it knows no sequences
        return {k: v for k, v in keys.items() if k != "seed" and not k.startswith(BESIDE)}

    def figure(self, key: str) -> float:
        value = self.metrics.get(key, float("nan"))
        return 100 * value if "%" in FIGURES[key] else value


def collect(where: str) -> tuple[list[Run], list[tuple[Path, str]]]:
    """The finished runs in a folder, at any depth, or in all folders that a pattern names; and the
    folders of those that are not whole, with the reason. Errors: RunError if there are none."""
    places = [Path(place) for place in sorted(glob.glob(where, recursive=True))]
    if not places:
        raise RunError(f"runs={where}: there is no such folder")
    folders = sorted({path.parent for place in places for path in place.rglob(CONFIG)})
    runs, broken = [], []
    for folder in folders:
        try:
            runs.append(read(folder))
        except RunError as error:
            broken.append((folder, str(error)))
    if not runs:
        reasons = "".join(f"; {reason}" for _, reason in broken[:3])
        raise RunError(f"runs={where}: holds no finished run{reasons}")
    return runs, broken


def read(folder: Path) -> Run:
    """Errors: RunError if the run is not finished, or a file of it is damaged."""
    config = stored_config(folder)
    path = folder / METRICS
    if not path.is_file():
        raise RunError(f"{folder}: not finished, there is no {METRICS}")
    try:
        metrics = json.loads(path.read_text())
        numbers = all(isinstance(value, int | float) for value in metrics.values())
    except (ValueError, AttributeError, OSError) as error:
        raise RunError(f"{path} is damaged ({error})") from error
    if not numbers or "test/exact_match" not in metrics:
        raise RunError(f"{path} is damaged (it lacks figures)")
    outcome = Outcome.load(folder / ERRORS)
    return Run(folder, config, metrics, outcome, outcome.figures()[1])


@dataclass(frozen=True, eq=False)
class Group:
    """Runs that differ in nothing but the seed.

    network, data: as a reader knows them. length: N, or k rings, or None for a network without
    spirals. metric: None for such a network. others: the other settings that differ somewhere.
    """

    network: str
    data: str
    length: str | None
    metric: bool | None
    others: tuple[tuple[str, Any], ...]
    runs: list[Run]

    @property
    def curves(self) -> np.ndarray:
        """float [R, T], one for each seed."""
        return np.stack([run.curve for run in self.runs])

    def label(self, *without: str) -> str:
        """What tells this group from others that are alike in the fields, or other settings, so
        named."""
        parts = []
        if "network" not in without:
            parts.append(self.network + ("++" if self.metric and "metric" not in without else ""))
        elif "metric" not in without and self.metric is not None:
            parts.append("with metric information" if self.metric else "without")
        if "length" not in without and self.length:
            parts.append(self.length)
        if "data" not in without:
            parts.append(self.data)
        others = [f"{k.split('.', 1)[-1]} {plain(v)}" for k, v in self.others if k not in without]
        return ", ".join([*parts, *others])


def grouped(runs: list[Run]) -> list[Group]:
    """The groups, in the order of their first runs."""
    others, groups = varied(runs), {}
    several = len({json.dumps(data_settings(run)) for run in runs}) > len(
        {run.config["data"]["name"] for run in runs}
    )
    for run in runs:
        model, settings = run.config["model"], run.settings
        spirals = model["name"] != "gcnn3"
        length = None
        if spirals:
            rings = model.get("rings")
            length = f"{rings} rings" if rings else f"N = {run.config['seq_len']}"
        data = run.config["data"]["name"]
        if several:
            data += "".join(
                f" {value}" for key, value in data_settings(run).items() if key != "name"
            )
        theirs = tuple((key, settings[key]) for key in others if key in settings)
        group = (
            NETWORKS.get(model["name"], model["name"]),
            data,
            length,
            model.get("metric"),
            theirs,
        )
        groups.setdefault(json.dumps(group), (*group, []))[-1].append(run)
    return [Group(*group) for group in groups.values()]


def data_settings(run: Run) -> dict[str, Any]:
    """Which data set, without what is set of every data set."""
    left_out = ("shot", "shuffle_vertices", "cache_dir", "workers", "root")
    return {key: value for key, value in run.config["data"].items() if key not in left_out}


def varied(runs: list[Run]) -> list[str]:
    """The settings that differ: between runs of one network, or, but for the model's, of any two.
    Those that a group has a field for are left out."""
    found = set()
    networks = {run.config["model"]["name"] for run in runs}
    for network in [None, *networks]:
        several = [r.settings for r in runs if network in (None, r.config["model"]["name"])]
        for key in set().union(*several):
            if network is None and (key.startswith("model.") or not all(key in s for s in several)):
                continue
            if len({json.dumps(settings.get(key)) for settings in several}) > 1:
                found.add(key)
    fields = {"model.name", "model.metric", "model.rings", "seq_len"}
    fields |= {f"data.{key}" for run in runs for key in data_settings(run)}
    return sorted(found - fields)


def labelled(groups: list[Group], *without: str) -> dict[str, np.ndarray]:
    """Curves [R, T] by what tells the groups apart."""
    for key in {key for group in groups for key, _ in group.others}:
        if len({json.dumps(dict(group.others).get(key)) for group in groups}) == 1:
            without += (key,)
    for field in ("data", "length"):
        if len({getattr(group, field) for group in groups}) == 1:
            without += (field,)
    return {group.label(*without): group.curves for group in groups}


def arrangements(groups: list[Group]) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """All groups; and the figures of the paper that they allow: a title, and curves [R, T] by name.

    Networks at one N; several N of one network; with and without metric information.
    """

    def alike(what: str) -> list[list[Group]]:
        """Groups that agree in all other fields, if they are several."""
        keys = [f for f in ("network", "data", "length", "metric", "others") if f != what]
        found: dict[str, list[Group]] = {}
        for group in groups:
            found.setdefault(json.dumps([getattr(group, k) for k in keys]), []).append(group)
        return [several for several in found.values() if len(several) > 1]

    yield "All runs", labelled(groups)
    spirals = [group for group in groups if group.length]
    for data, length, metric in dict.fromkeys((g.data, g.length, g.metric) for g in spirals):
        here = [g for g in spirals if (g.data, g.length, g.metric) == (data, length, metric)]
        here += [g for g in groups if g.data == data and not g.length]
        if len({g.network for g in here}) > 1:
            what = f"{length} {'with' if metric else 'without'} metric information"
            yield f"Networks at {what}, {data}", labelled(here, "length", "data", "metric")
    for here in alike("length"):
        yield f"Lengths of {here[0].label('length')}", labelled(here, "network", "metric")
    for here in alike("metric"):
        title = f"Metric information: {here[0].label('metric')}"
        yield title, labelled(here, "network", "length", "data")


# ------------------------------------------------------------------------------------- the tables


def run_table(groups: list[Group]) -> tuple[list[str], list[list[Any]]]:
    """Names of columns, and a row for each run."""
    others = sorted({key for group in groups for key, _ in group.others})
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
    others = sorted({key for group in groups for key, _ in group.others})
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
    """The mean, and the standard deviation of several seeds, as a reader wants them."""
    if key == "parameters":
        return f"{values[0]:,.0f}"
    digits = 1 if "%" in FIGURES[key] else 0 if key.startswith("seconds") else 4
    several = f" ± {np.std(values):.{digits}f}" if len(values) > 1 else ""
    return f"{np.mean(values):.{digits}f}{several}"


def plain(value: Any) -> str:
    """As a reader wants it."""
    if value is None:
        return "\u2013"
    return (
        {True: "yes", False: "no"}.get(value, str(value)) if isinstance(value, bool) else str(value)
    )


def escaped(text: str) -> str:
    for character in "\\_%&#${}":
        text = text.replace(character, {"\\": r"\textbackslash "}.get(character, "\\" + character))
    return text
