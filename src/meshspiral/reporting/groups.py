"""Groups of runs that differ in the seed alone, and what tells the groups apart."""

from __future__ import annotations

import itertools
import json
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from meshspiral.data.descriptors import Descriptor
from meshspiral.experiment.schema import TrainConfig
from meshspiral.geometry.digest import digest
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.nn.networks import Network
from meshspiral.reporting.runs import Run

# data settings that do not tell data sets apart
COMPUTED = ("features", "shuffle_vertices", "half")
TRAINING = (
    "fresh",
    "damage",
    "remesh.copies",
    "remesh.shared",
)  # these change training shapes only


@dataclass(frozen=True, eq=False)
class Group:
    """Runs that differ in the seed alone.

    Attributes:
        network: Title of the network.
        data: Label of the data set, see `data_labels`.
        length: Label of the sequences' length, e.g. "N = 20"; None for a network without sequences.
        metric: Whether the network reads metric information; None if it cannot.
        others: The other settings that differ between groups: flat key and value.
        runs: At least one run.
    """

    network: str
    data: str
    length: str | None
    metric: bool | None
    others: tuple[tuple[str, Any], ...]
    runs: list[Run]

    @property
    def seeds(self) -> set[int]:
        return {run.config.seed for run in self.runs}

    @property
    def curves(self) -> np.ndarray:
        """The curves of all runs, float64 [R, T] over THRESHOLDS."""
        return np.stack([run.curve for run in self.runs])

    def label(self, *omit: str) -> str:
        """A label that tells this group from others.

        Args:
            *omit: Attributes of the group and keys of `others` to leave out, because they are equal
                in the groups shown together.
        """
        parts = []
        if "network" not in omit:
            parts.append(self.network + ("++" if self.metric and "metric" not in omit else ""))
        elif "metric" not in omit and self.metric is not None:
            parts.append("with metric information" if self.metric else "without")
        if "length" not in omit and self.length:
            parts.append(self.length)
        if "data" not in omit:
            parts.append(self.data)
        others = [f"{short_key(k)} {format_value(v)}" for k, v in self.others if k not in omit]
        return ", ".join([*parts, *others])


def group_runs(runs: list[Run]) -> list[Group]:
    """Group runs, and sort the groups by data set, network, length and metric information."""
    keys, titles, groups = varied_settings(runs), network_titles(runs), {}
    for run, data in zip(runs, data_labels(runs), strict=True):
        fields = (
            titles[run.config.model.name],
            data,
            Neighbourhood.of(run.config.neighbourhood).length_label,
            getattr(run.config.model, "metric", None),
            tuple((key, run.settings[key]) for key in keys if key in run.settings),
        )
        groups.setdefault(json.dumps(fields), (*fields, []))[-1].append(run)

    def rank(group: Group) -> tuple:
        number = re.search(r"\d+", group.length or "")
        length = int(number[0]) if number else 0
        return group.data, group.network, bool(group.length), length, bool(group.metric)

    return sorted((Group(*fields) for fields in groups.values()), key=rank)


def network_titles(runs: list[Run]) -> dict[str, str]:
    """The title of each network by its name; networks with equal titles also show their name."""
    titles = {name: Network.registered[name].title for name in (r.config.model.name for r in runs)}
    counts = list(titles.values())
    return {n: t if counts.count(t) == 1 else f"{t} ({n})" for n, t in titles.items()}


def data_labels(runs: list[Run]) -> list[str]:
    """A label for the data set of each run.

    It consists of the data set's name, the policy of remeshing, the settings in which data sets of
    that name and policy differ, and a number if their test shapes still differ, as those of two
    folders do.
    """
    datas = [
        {k.removeprefix("data."): v for k, v in run.settings.items() if k.startswith("data.")}
        for run in runs
    ]
    labels: list[str] = []
    for data in datas:
        kind = data["name"], data.get("remesh.policy")
        same_kind = [d for d in datas if (d["name"], d.get("remesh.policy")) == kind]
        differing = [k for k, v in data.items() if any(other.get(k) != v for other in same_kind)]
        values = [_label(key, data[key]) for key in differing if not is_computed(key)]
        labels.append(" ".join([*filter(None, kind), *values]))
    hashes: dict[str, list[str]] = {}  # of the test shapes, by label
    for i, run in enumerate(runs):
        outcome = run.outcome
        # each seed shuffles in another order
        labelled = np.sort(outcome.labels) if run.config.data.shuffle_vertices else outcome.labels
        shapes = digest(np.array(outcome.names), labelled, outcome.diameter)
        known = hashes.setdefault(labels[i], [])
        if shapes not in known:
            known.append(shapes)
        if number := known.index(shapes):
            labels[i] += f" ({number + 1})"
    return labels


def _label(key: str, value: Any) -> str:
    """A setting in the label of a data set: names and numbers as they are, lists as a hash."""
    if isinstance(value, str) or (isinstance(value, int) and not isinstance(value, bool)):
        return str(value)
    if isinstance(value, list | dict):
        return digest(json.dumps(value))[:6]
    return f"{short_key(key)} {format_value(value)}"


def is_computed(key: str) -> bool:
    """Whether a setting of a data set does not say which shapes it tests on."""
    group = key.partition(".")[0]
    return key in (*COMPUTED, *TRAINING) or group in TRAINING or group in Descriptor.registered


def varied_settings(runs: list[Run]) -> list[str]:
    """Keys of the settings that differ between two runs and that no attribute of a group shows.

    A setting of the network, or the neighbourhood's name, counts only if it differs between two
    runs of one network.
    """
    keys = {k for k in differing_keys(runs) if not k.startswith(("model.", "neighbourhood"))}
    for name in {run.config.model.name for run in runs}:
        keys |= differing_keys([run for run in runs if run.config.model.name == name])
    shown = {"model.name", "model.metric"} | length_keys(runs)
    shown |= {k for k in keys if k.startswith("data.") and not is_computed(k[5:])}
    return sorted(keys - shown)


def differing_keys(runs: list[Run]) -> set[str]:
    """Keys of the settings that differ between two of the runs that have them.

    The key of a group that one run has and another has not, such as `data.damage`, differs too.
    """
    values: dict[str, set[str]] = {}
    for run in runs:
        for key, value in run.settings.items():
            values.setdefault(key, set()).add(json.dumps(value))
    for key in values:
        for group in itertools.accumulate(key.split(".")[:-1], "{}.{}".format):
            if group in values:
                values[group].add("a group")
    return {key for key, several in values.items() if len(several) > 1}


def length_keys(runs: list[Run]) -> set[str]:
    """Keys of the neighbourhoods' settings that the length's label shows.

    A setting is shown if the label changes when the setting takes the value of another run.
    """
    distinct = {n.model_dump_json(): n for n in (run.config.neighbourhood for run in runs)}
    keys = set()
    for one, other in itertools.permutations(distinct.values(), 2):
        if one.name != other.name:
            continue
        label = Neighbourhood.of(one).length_label
        for field in type(one).model_fields:
            changed = one.model_copy(update={field: getattr(other, field)})
            if Neighbourhood.of(changed).length_label != label:
                keys.add(f"{one.name}.{field}")
    return keys


def other_keys(groups: list[Group]) -> list[str]:
    """Keys of the settings in `others` of any group."""
    return sorted({key for group in groups for key, _ in group.others})


def short_key(key: str) -> str:
    """A flat key without its config group: "optim.lr" is "lr", "patch.radius" stays."""
    group, _, rest = key.partition(".")
    return rest if rest and group in TrainConfig.model_fields else key


def format_value(value: Any) -> str:
    """A setting as text for plots and tables."""
    if value is None:
        return "\u2013"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value)
