"""What `python -m src.match` computes and writes for each mesh."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from omegaconf import DictConfig
from scipy.spatial.transform import Rotation

from meshspiral.data.attributes import KINDS, read_attribute
from meshspiral.data.cache import digest
from meshspiral.data.scans import Scan, open_scan
from meshspiral.data.shapes import DataError
from meshspiral.experiment.runs import BEST, write_arrays, write_whole
from meshspiral.geometry.mesh import Mesh, MeshError
from meshspiral.matching.exports import write_carried, write_colored, write_lines
from meshspiral.matching.matcher import SHIPPED, Labels, Matcher, nearest
from meshspiral.viz.plots import (
    confidence_colors,
    encoded,
    picture_figure,
    place_colors,
    template_colors,
)
from meshspiral.viz.render import RenderError, Row, render

FILE = "match.npz"
TARGET = ("target.npz", "target.ply")
OURS = (
    FILE,
    "map.txt",
    "template.txt",
    "remarks.txt",
    "source.ply",
    "transferred.npy",
    "transferred.ply",
    "transferred.obj",
    "correspondence.png",
    "confidence.png",
)

log = logging.getLogger(__name__)


class Side(NamedTuple):
    """A mesh and what a network says of it."""

    scan: Scan
    labels: Labels

    def of_mesh(self, values: np.ndarray) -> np.ndarray:
        """Values [V, ...] of the user's vertices as those of the vertices of `scan.mesh`."""
        return values[self.scan.origin]


class Matched(NamedTuple):
    """One mesh and its labels; and those of the target and the map to it, int32 [V], or None."""

    source: Side
    target: Side | None
    map: np.ndarray | None


@dataclass(frozen=True)
class Job:
    """What is the same for all meshes of a command. Its parts are computed once per process."""

    run: str
    target: str | None
    repair: bool
    resample: bool | None
    smooth: bool
    transfer: str | None
    accelerator: str
    picture: bool

    @classmethod
    def of(cls, config: DictConfig, picture: bool) -> Job:
        return cls(
            str(config.run or SHIPPED),
            config.target,
            config.repair,
            config.resample,
            config.smooth,
            config.transfer,
            config.accelerator,
            picture,
        )

    def matcher(self) -> Matcher:
        return _matcher(self.run, self.accelerator, self.resample, self.smooth)

    def target_labels(self) -> Side | None:
        return _target(self) if self.target else None

    def carried(self) -> np.ndarray | None:
        """What is to be carried over, of the target's vertices."""
        return _carried(self) if self.transfer else None

    def inputs(self) -> list[str]:
        """The files it reads beside the sources."""
        files = [self.target, None if self.transfer in KINDS else self.transfer]
        return [file for file in files if file]

    def key(self, path: str) -> str:
        """The same as long as mesh, target, network and settings are."""
        return digest(_content(path), _common(self))


@cache
def _matcher(run: str, accelerator: str, resampled: bool | None, smooth: bool) -> Matcher:
    return Matcher.load(run, accelerator=accelerator, resampled=resampled, smooth=smooth)


@cache
def _target(job: Job) -> Side:
    scan = open_scan(job.target, job.repair)
    return Side(scan, job.matcher().label(scan))


@cache
def _carried(job: Job) -> np.ndarray:
    return read_attribute(job.target, job.transfer, len(job.target_labels().scan.vertices))


@cache
def _common(job: Job) -> str:
    files = [str(Path(job.run) / BEST), *job.inputs()]
    settings = job.repair, job.resample, job.smooth, job.transfer, job.picture
    return digest(*(_content(file) for file in files), *settings)


def _content(path: str) -> str:
    try:
        return digest(np.fromfile(path, dtype=np.uint8))
    except OSError as error:
        raise MeshError(f"{path}: {error.strerror or error}") from error


def done(job: Job, path: str, folder: Path) -> bool:
    """Whether the folder holds the match of that mesh, whole."""
    try:
        with np.load(folder / FILE, allow_pickle=False) as file:
            return str(file["key"]) == job.key(path) and str(file["source"]) == _absolute(path)
    except Exception:  # whatever numpy says of a file that is not there, or not whole
        return False


class Attempt(NamedTuple):
    """refused: in words, why; or None. mended: whether something of the mesh was changed."""

    path: str
    refused: str | None
    mended: bool


def attempt(job: Job, path: str, folder: Path, processes: int) -> Attempt:
    """`one` in a process of several."""
    import torch

    if processes > 1:
        torch.set_num_threads(1)
    try:
        found = one(job, path, folder)
    except (MeshError, DataError) as error:
        return Attempt(path, str(error), False)
    return Attempt(path, None, any("mended" in line for line in found.source.scan.remarks))


def _absolute(path: str) -> str:
    return str(Path(path).resolve())


def one(job: Job, path: str, folder: Path) -> Matched:
    """Match a mesh and write what it gives. Errors: MeshError, DataError; OSError from writing."""
    scan, carried, target = open_scan(path, job.repair), job.carried(), job.target_labels()
    source = Side(scan, job.matcher().label(scan))
    found = Matched(source, target, nearest(source.labels, target.labels) if target else None)
    spare(folder, path, *job.inputs())
    _claim(folder, path)
    for old in OURS if target else OURS + TARGET:
        (folder / old).unlink(missing_ok=True)
    template = job.matcher().template
    arrays = source.labels._asdict()
    colors = place_colors(template, source.labels.points)
    if target:
        arrays["map"] = found.map
        write_lines(folder / "map.txt", found.map)
        colors = taken(found.map, place_colors(template, target.labels.points), 0.6)
    write_lines(folder / "template.txt", source.labels.template)
    write_whole(folder / "remarks.txt", "\n".join(told(found)) + "\n")
    write_colored(folder / "source.ply", scan, colors)
    if carried is not None:
        write_carried(folder, scan, taken(found.map, carried, 0), job.transfer)
    if job.picture:
        draw(folder, job, found)
    names = {"key": np.array(job.key(path)), "source": np.array(_absolute(path))}
    write_arrays(folder / FILE, **names, **arrays)  # the last: now all is there
    return found


def spare(folder: Path, *inputs: str) -> None:
    """Errors: DataError if what is to be written to the folder would take an input's place."""
    ours = {(folder / name).resolve() for name in OURS + TARGET}
    for path in inputs:
        if Path(path).resolve() in ours:
            raise DataError(f"{path} would be overwritten; choose another folder with output=")


def _claim(folder: Path, path: str) -> None:
    """Errors: DataError if the folder holds the match of another mesh."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with np.load(folder / FILE, allow_pickle=False) as file:
            other = str(file["source"])
    except Exception:  # whatever numpy says of a file that is not there, or not whole
        return
    if other != _absolute(path):
        raise DataError(f"{folder} holds the match of {other}; choose another with output=")


def write_target(job: Job, folder: Path) -> None:
    """target.npz and target.ply, which are the same for all sources."""
    spare(folder, *job.inputs())
    scan, labels = job.target_labels()
    folder.mkdir(parents=True, exist_ok=True)
    write_arrays(folder / "target.npz", **labels._asdict())
    write_colored(folder / "target.ply", scan, place_colors(job.matcher().template, labels.points))


def taken(match: np.ndarray, values: np.ndarray, nothing: float) -> np.ndarray:
    """For every source vertex the value [Vb, ...] of its counterpart, [Va, ...]."""
    found = values[match]
    found[match < 0] = nothing
    return found


def told(found: Matched) -> list[str]:
    """What is to say of it, in lines."""
    lines = []
    for what, side in (("source", found.source), ("target", found.target)):
        if side is not None:
            scan, labels = side
            known = labels.template >= 0
            lines.append(
                f"{what}: {scan.mesh.name}, {len(scan.vertices):,} vertices; confidence "
                f"{np.median(labels.confidence[known]):.2f} in the median, below 0.1 at "
                f"{100 * (labels.confidence[known] < 0.1).mean():.1f} %"
            )
            lines += [f"  {remark}" for remark in scan.remarks]
    return lines


def draw(folder: Path, job: Job, found: Matched) -> None:
    """correspondence.png and confidence.png: the target, or else the template, and the source,
    turned to stand as the template does. Without an OpenGL library a warning takes their place."""
    template = job.matcher().template
    source, target = found.source, found.target
    if target:
        theirs = place_colors(template, target.labels.points)
        colors = [target.of_mesh(theirs), source.of_mesh(taken(found.map, theirs, 0.6))]
        meshes, sure = [standing(target, template)], [target.of_mesh(target.labels.confidence)]
    else:
        colors = [
            template_colors(template),
            source.of_mesh(place_colors(template, source.labels.points)),
        ]
        meshes, sure = [template], [np.ones(len(template.vertices))]
    meshes.append(standing(source, template))
    sure.append(source.of_mesh(source.labels.confidence))
    try:
        rows = [Row(meshes, colors), Row(meshes, [confidence_colors(each) for each in sure])]
        correspondence, confidence = render(rows, job.matcher().up)
    except RenderError as error:
        log.warning("no pictures: %s", error)
        return
    names = ["target" if target else "template", "source"]
    figures = {
        "correspondence": picture_figure(*correspondence, names),
        "confidence": picture_figure(*confidence, names, bar="confidence"),
    }
    for name, figure in figures.items():
        write_whole(folder / f"{name}.png", encoded(figure, "png"))


def standing(side: Side, template: Mesh) -> Mesh:
    """The mesh turned and scaled to stand as the template does (Kabsch 1976)."""
    mesh, points = side.scan.mesh, side.of_mesh(side.labels.points)
    weights = side.of_mesh(side.labels.confidence) + 1e-6
    scaled = mesh.vertices * np.sqrt(template.area / mesh.area)
    scaled -= np.average(scaled, axis=0, weights=weights)
    there = points - np.average(points, axis=0, weights=weights)
    turn, _ = Rotation.align_vectors(there, scaled, weights)
    return Mesh(turn.apply(scaled), mesh.faces, mesh.name)
