"""What all meshes of a `match` command share: the network, the target and values to transfer."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from meshspiral.data.attributes import KINDS, read_attribute
from meshspiral.data.scans import Scan, open_scan
from meshspiral.experiment.run_folder import BEST
from meshspiral.experiment.schema import MatchConfig, read_config
from meshspiral.geometry.digest import digest
from meshspiral.geometry.mesh import MeshError
from meshspiral.matching.matcher import Labels, Matcher, nearest_vertices
from meshspiral.training.checkpoints import BUNDLED_RUN


class LabelledScan(NamedTuple):
    """A scan and the labels of its V vertices."""

    scan: Scan
    labels: Labels

    def on_mesh(self, values: np.ndarray) -> np.ndarray:
        """Values of the W vertices of `scan.mesh`, [W, ...], from those of the V, [V, ...]."""
        return values[self.scan.origin]


class FileMatch(NamedTuple):
    """A labelled mesh file, matched to the target if there is one.

    Attributes:
        path: The source's file.
        source: The source and its labels.
        target: The target and its labels; None without a target.
        map: int32 [V], for each source vertex a target vertex or -1; None without a target.
    """

    path: str
    source: LabelledScan
    target: LabelledScan | None
    map: np.ndarray | None


class MatchJob:
    """The settings of a command, and what they name: each is read and computed on first use.

    Pickled, it is its settings alone: a worker process makes one job of them and keeps it.

    Args:
        config: The settings.
        render: Whether to render every match.
    """

    def __init__(self, config: MatchConfig, render: bool):
        self.config, self.render = config, render

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str, bool]]:
        return _job_of_process, (self.config.model_dump_json(), self.render)

    @cached_property
    def matcher(self) -> Matcher:
        """Raises RunError and ConfigError as `Matcher.load` does."""
        return Matcher.load(
            self.config.run,
            accelerator=self.config.accelerator,
            resampled=self.config.resample,
            smooth=self.config.smooth,
        )

    @cached_property
    def target(self) -> LabelledScan | None:
        """The labelled target. Raises MeshError as `open_scan` and `Matcher.label` do."""
        if self.config.target is None:
            return None
        scan = open_scan(self.config.target, self.config.repair)
        return LabelledScan(scan, self.matcher.label(scan))

    @cached_property
    def transfer_values(self) -> np.ndarray | None:
        """Values of the target's vertices, [V, ...]. Raises DataError as `read_attribute` does."""
        if not self.config.transfer:
            return None
        vertices = len(self.target.scan.vertices)
        return read_attribute(self.config.target, self.config.transfer, vertices)

    def prepare(self) -> None:
        """Label the target and read the values to transfer, so that their errors come first."""
        _ = self.target, self.transfer_values

    @property
    def inputs(self) -> list[str]:
        """The files that are read beside the sources and the network."""
        array = None if self.config.transfer in KINDS else self.config.transfer
        return [path for path in (self.config.target, array) if path]

    def label(self, path: str, scan: Scan) -> FileMatch:
        """Label a source, and match it to the target if there is one.

        Args:
            path: The source's file.
            scan: Its content.

        Raises:
            MeshError: The mesh cannot be described, resampled or smoothed.
        """
        source, target = LabelledScan(scan, self.matcher.label(scan)), self.target
        match = nearest_vertices(source.labels, target.labels) if target else None
        return FileMatch(path, source, target, match)

    def key(self, path: str) -> str:
        """A hash of all that a match depends on: the source's content, inputs and settings.

        Raises:
            MeshError: The source or an input cannot be read.
        """
        return digest(_content(path), self._shared_key)

    @cached_property
    def _shared_key(self) -> str:
        config = self.config
        files = [str(Path(config.run or BUNDLED_RUN) / BEST), *self.inputs]
        settings = config.repair, config.resample, config.smooth, config.transfer, self.render
        return digest(*map(_content, files), *settings)


@lru_cache(maxsize=1)
def _job_of_process(config: str, render: bool) -> MatchJob:
    """The job of this worker process, from its settings as JSON."""
    return MatchJob(read_config(MatchConfig, json.loads(config)), render)  # imports plugins too


def _content(path: str) -> str:
    try:
        return digest(np.fromfile(path, dtype=np.uint8))
    except OSError as error:
        raise MeshError(f"{path}: {error.strerror or error}") from error
