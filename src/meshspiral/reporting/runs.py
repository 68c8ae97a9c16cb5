"""Finished runs, read from their folders."""

from __future__ import annotations

import glob
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from meshspiral.evaluation.outcome import Outcome
from meshspiral.experiment.run_folder import (
    CONFIG,
    ERRORS,
    RunError,
    read_metrics,
    read_run_config,
)
from meshspiral.experiment.schema import TrainConfig, flat

# these settings do not change what is computed, or stand for others that do
LEFT_OUT = {
    "trainer.accelerator",
    "trainer.threads",
    "trainer.strategy",
    "data.cache_dir",
    "data.workers",
    "data.readers",
    "data.root",
    "data.benchmark_root",
    "picture",
    "plugins",
    "resume",
    "seed",
    "metric",  # model.metric has its value
    "seq_len",  # a neighbourhood with sequences has its value
}


@dataclass(frozen=True, eq=False)
class Run:
    """A finished run.

    Attributes:
        folder: The run folder.
        config: Its config.
        metrics: The content of metrics.json.
        outcome: Predictions and errors on the test shapes.
        curve: Share of correct matches in 0..1 over THRESHOLDS, float64 [T].
    """

    folder: Path
    config: TrainConfig
    metrics: dict[str, float]
    outcome: Outcome
    curve: np.ndarray

    @cached_property
    def settings(self) -> dict[str, Any]:
        """The settings that change what is computed, except the seed, by flat key.

        Keys of the neighbourhood begin with its name, as in "patch.radius": one name can mean
        different things in two neighbourhoods.
        """
        values = self.config.model_dump(mode="json")
        neighbourhood = values.pop("neighbourhood")
        name = neighbourhood.pop("name")
        keys = flat({**values, "neighbourhood": name, name: neighbourhood})
        return {key: value for key, value in keys.items() if key not in LEFT_OUT}


def read_run(folder: Path) -> Run:
    """Read a finished run. Imports no plugins.

    Raises:
        RunError: The run is not finished, a file of it is damaged, or it needs a plugin.
    """
    config, metrics = read_run_config(folder), read_metrics(folder)
    outcome = Outcome.load(folder / ERRORS)
    return Run(folder, config, metrics, outcome, outcome.metrics()[1])


def read_runs(pattern: str) -> tuple[list[Run], list[str]]:
    """Read all finished runs in some folders, at any depth.

    Args:
        pattern: A folder, or a glob pattern of folders.

    Returns:
        The runs; and for each run that cannot be read, one line that says which and why.

    Raises:
        RunError: There is no finished run.
    """
    roots = [Path(pattern)]
    if not roots[0].is_dir():
        roots = [Path(path) for path in glob.glob(pattern, recursive=True)]
    if not roots:
        raise RunError(f"runs={pattern}: there is no such folder")
    folders = sorted({path.parent for root in roots for path in root.rglob(CONFIG)})
    runs, omitted = [], []
    for folder in folders:
        try:
            runs.append(read_run(folder))
        except RunError as error:
            omitted.append(str(error))
    if not runs:
        reasons = "".join(f"; {reason}" for reason in omitted[:3])
        raise RunError(f"runs={pattern} contains no finished run{reasons}")
    return runs, omitted


def common_folder(pattern: str) -> Path:
    """The folder itself, or for a glob pattern the part of its path without wildcards."""
    if Path(pattern).is_dir():
        return Path(pattern)
    parts = Path(pattern).parts
    fixed = next((i for i, part in enumerate(parts) if re.search(r"[*?\[]", part)), len(parts))
    return Path(*parts[:fixed])
