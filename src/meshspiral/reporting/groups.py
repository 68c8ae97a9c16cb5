"""Finished runs side by side: what differs between them, their groups of seeds, tables."""

from __future__ import annotations

import glob
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from meshspiral.data.cache import digest
from meshspiral.evaluation.outcome import ERRORS, Outcome
from meshspiral.experiment.runs import CONFIG, METRICS, RunError, stored_config
from meshspiral.experiment.schema import flat

# where a run was computed, or what its picture shows: not what was computed
BESIDE = (
    "trainer.accelerator",
    "trainer.threads",
    "trainer.strategy",
    "data.cache_dir",
    "data.workers",
    "data.root",
    "data.benchmark_root",
    "picture",
    "resume",
    "metric",
)
SHARED = ("shot.", "shuffle_vertices")  # settings of every data set, not what tells them apart
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
    places = [Path(where)] if Path(where).is_dir() else map(Path, glob.glob(where, recursive=True))
    places = sorted(places)
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
    def seeds(self) -> set[int]:
        return {run.config["seed"] for run in self.runs}

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
    """The groups, by network, length and metric information."""
    others, groups = varied(runs), {}
    for run, data in zip(runs, data_names(runs), strict=True):
        model, settings = run.config["model"], run.settings
        rings, length = model.get("rings"), None
        if "seq_len" in settings:
            length = f"{rings} rings" if rings else f"N = {run.config['seq_len']}"
        theirs = tuple((key, settings[key]) for key in others if key in settings)
        group = (NETWORKS[model["name"]], data, length, model.get("metric"), theirs)
        groups.setdefault(json.dumps(group), (*group, []))[-1].append(run)

    def place(group: Group):
        number = int(re.search(r"\d+", group.length or "0")[0])
        return group.data, group.network, bool(group.length), number, bool(group.metric)

    return sorted((Group(*group) for group in groups.values()), key=place)


def data_names(runs: list[Run]) -> list[str]:
    """For each run the name of its data set, with the policy it was remeshed by, the settings in
    which sets of that name differ, and a number where their test shapes differ all the same, as
    those of two folders do."""
    ways = [
        {k.removeprefix("data."): v for k, v in run.settings.items() if k.startswith("data.")}
        for run in runs
    ]
    names: list[str] = []
    for way in ways:
        kind = way["name"], way.get("remesh.policy")
        alike = [w for w in ways if (w["name"], w.get("remesh.policy")) == kind]
        differ = [k for k, v in way.items() if any(other.get(k) != v for other in alike)]
        said = [
            v if isinstance(v, str | int) else digest(json.dumps(v))[:6]
            for v in (way[k] for k in differ if not k.startswith(SHARED))
        ]
        names.append(" ".join([*filter(None, kind), *map(str, said)]))
    kinds: dict[str, list[str]] = {}
    for i, run in enumerate(runs):
        kept = run.outcome
        shuffled = run.config["data"]["shuffle_vertices"]  # by each seed in another order
        labels = np.sort(kept.labels) if shuffled else kept.labels
        truth = digest(np.array(kept.names), labels, kept.diameter)
        known = kinds.setdefault(names[i], [])
        if truth not in known:
            known.append(truth)
        if number := known.index(truth):
            names[i] += f" ({number + 1})"
    return names


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
    of_data = {k for k in found if k.startswith("data.") and not k[5:].startswith(SHARED)}
    return sorted(found - fields - of_data)


def other_settings(groups: list[Group]) -> list[str]:
    """The settings without a field of their own in which some group differs from another."""
    return sorted({key for group in groups for key, _ in group.others})


def labelled(groups: list[Group], *without: str) -> dict[str, np.ndarray]:
    """Curves [R, T] by what tells the groups apart."""
    for key in other_settings(groups):
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


def plain(value: Any) -> str:
    """As a reader wants it."""
    if value is None:
        return "\u2013"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value)
