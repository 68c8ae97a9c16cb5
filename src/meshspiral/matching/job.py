"""What all meshes of a `match` command share: the network, the target and values to transfer."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from meshspiral.data.attributes import KINDS, read_attribute
from meshspiral.data.scans import Scan, open_scan
from meshspiral.evaluation.distributions import Distributions
from meshspiral.experiment.run_folder import BEST
from meshspiral.experiment.schema import MatchConfig, read_config
from meshspiral.geometry.digest import digest
from meshspiral.geometry.mesh import MeshError
from meshspiral.matching.matcher import MESH_STAGES, Labels, Matcher, nearest_vertices
from meshspiral.training.checkpoints import BUNDLED_RUN

CONTENT = "sides"  # part of the key: earlier versions wrote other labels, so it is done anew
# settings that change no match, and those whose files are in the key
NOT_IN_KEY = {
    "source",
    "sources",
    "target",
    "run",
    "output",
    "picture",
    "accelerator",
    "workers",
    "plugins",
}
STAGES = ("reading", *MESH_STAGES)  # of a mesh file
FileReport = Callable[[str, str], None]  # is told "source" or "target", and a stage that begins


class LabelledScan(NamedTuple):
    """A scan, the labels of its V vertices, and what they were chosen from."""

    scan: Scan
    labels: Labels
    distributions: Distributions

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
        confidence: float32 [V], `confidence` of `Match`; None without a target.
    """

    path: str
    source: LabelledScan
    target: LabelledScan | None
    map: np.ndarray | None
    confidence: np.ndarray | None

    @property
    def source_confidence(self) -> np.ndarray:
        """The confidence to show, float32 [V]: that of the map, or near the template's vertices."""
        return self.source.labels.near_confidence if self.confidence is None else self.confidence


class MatchJob:
    """The settings of a command, and what they name: each is read and computed on first use.

    Pickled, it is its settings alone: a worker process makes one job of them and keeps it.

    Args:
        config: The settings.
        render: Whether to render every match.
    """

    def __init__(self, config: MatchConfig, render: bool):
        self.config, self.render = config, render
        self.with_page = not config.sources or config.picture is not False

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
            refine=self.config.refine,
            unflip=self.config.unflip,
            ensemble=self.config.ensemble,
            scale=self.config.scale,
            height=self.config.height,
        )

    @cached_property
    def target(self) -> LabelledScan | None:
        """The labelled target. Raises MeshError as `open_scan` and `Matcher.label` do."""
        return self._read_target(None)

    def _read_target(self, report: FileReport | None) -> LabelledScan | None:
        if self.config.target is None:
            return None
        return self._label_scan(self.read(self.config.target, report, "target"), report, "target")

    def read(self, path: str, report: FileReport | None = None, role: str = "source") -> Scan:
        """Read a mesh file, repaired on request. Raises MeshError as `open_scan` does."""
        if report:
            report(role, "reading")
        return open_scan(path, self.config.repair)

    def _label_scan(self, scan: Scan, report: FileReport | None, role: str) -> LabelledScan:
        of_role = partial(report, role) if report else None
        return LabelledScan(scan, *self.matcher.predict(scan, of_role))

    @cached_property
    def transfer_values(self) -> np.ndarray | None:
        """Values of the target's vertices, [V, ...]. Raises DataError as `read_attribute` does."""
        if not self.config.transfer:
            return None
        vertices = len(self.target.scan.vertices)
        return read_attribute(self.config.target, self.config.transfer, vertices)

    def prepare(self, report: FileReport | None = None) -> None:
        """Label the target and read the values to transfer, so that their errors come first."""
        if "target" not in vars(self):
            self.target = self._read_target(report)
        _ = self.transfer_values

    @property
    def inputs(self) -> list[str]:
        """The files that are read beside the sources and the network."""
        array = None if self.config.transfer in KINDS else self.config.transfer
        return [path for path in (self.config.target, array) if path]

    def label(self, path: str, scan: Scan, report: FileReport | None = None) -> FileMatch:
        """Label a source, and match it to the target if there is one.

        Args:
            path: The source's file.
            scan: Its content.
            report: Called with each stage.

        Raises:
            MeshError: The mesh cannot be described, resampled or smoothed.
        """
        source, target = self._label_scan(scan, report, "source"), self.target
        if target is None:
            return FileMatch(path, source, None, None, None)
        match = nearest_vertices(source.labels, target.labels)
        found = source.distributions, target.distributions
        return FileMatch(path, source, target, match, self.matcher.map_confidence(*found, match))

    def key(self, path: str) -> str:
        """A hash of all that a match depends on: the source's content, inputs and settings.

        Raises:
            MeshError: The source or an input cannot be read.
        """
        return digest(_content(path), self._shared_key)

    @cached_property
    def _shared_key(self) -> str:
        files = [str(Path(self.config.run or BUNDLED_RUN) / BEST), *self.inputs]
        settings = self.config.model_dump_json(exclude=NOT_IN_KEY)
        files_written = self.render, self.with_page, bool(self.config.sources)
        return digest(*map(_content, files), settings, *files_written, CONTENT)


@lru_cache(maxsize=1)
def _job_of_process(config: str, render: bool) -> MatchJob:
    """The job of this worker process, from its settings as JSON."""
    return MatchJob(read_config(MatchConfig, json.loads(config)), render)  # imports plugins too


def _content(path: str) -> str:
    try:
        return digest(np.fromfile(path, dtype=np.uint8))
    except OSError as error:
        raise MeshError(f"{path}: {error.strerror or error}") from error
