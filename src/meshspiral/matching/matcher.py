"""Matching two meshes: both are labelled with points of a template, and matched by these.

matcher = Matcher.load()
match = matcher.match(scan(*a, "a"), scan(*b, "b"))
match.target[v]     # the vertex of b that vertex v of a corresponds to
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from omegaconf import OmegaConf
from scipy.spatial import cKDTree

from meshspiral.data.datamodule import described_tensors, neighbourhood_tensors
from meshspiral.data.preprocessing import descriptor_task, neighbourhood_task
from meshspiral.data.scans import Scan
from meshspiral.data.sources import recipe_of
from meshspiral.experiment.runs import BEST, read_checkpoint
from meshspiral.experiment.schema import checked
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.resample import resample
from meshspiral.geometry.zoomout import TO, eigenfunctions, zoomout
from meshspiral.training.predictor import Predictor, template_of

SHIPPED = Path(__file__).parents[1] / "data" / "assets" / "bodies_run"
# A mesh with so many times more or fewer vertices than in training is resampled. Patches have a
# size of their own, while spirals grow with the edges.
ALIKE_PATCHES, ALIKE_SPIRALS = 4.0, 1.5


class Labels(NamedTuple):
    """What a network says of a mesh with V vertices.

    template: int32 [V], a vertex of the template, -1 where a vertex is on no face. points: float64
    [V, 3], the place on the template, NaN there. confidence: float32 [V], the probability that the
    network gives to that vertex of the template, 0 there.
    """

    template: np.ndarray
    points: np.ndarray
    confidence: np.ndarray


class Match(NamedTuple):
    """target: int32 [V], for every source vertex a vertex of the target, -1 where it has none.
    source_labels, target_labels: what both were given, of which the match is made."""

    target: np.ndarray
    source_labels: Labels
    target_labels: Labels


class Matcher:
    """A trained network with its template.

    saved: of `read_checkpoint`. accelerator: "cpu" or "gpu". resampled: True: meshes are resampled
    to the density of the meshes in training first, and what is predicted there is carried over;
    False: never; None: those of a density far from it. smooth: refine the labels of each mesh by
    ZoomOut. Errors: RunError for a checkpoint without template.
    """

    def __init__(
        self,
        saved: dict[str, Any],
        accelerator: str = "cpu",
        resampled: bool | None = None,
        smooth: bool = False,
    ):
        settings = OmegaConf.to_container(
            checked(OmegaConf.create(saved["hyper_parameters"]["config"]))
        )
        self.template = template_of(saved)
        self.up = saved["up"]
        self._resolution = int(saved["resolution"])
        self._resampled, self._smooth = resampled, smooth
        self._recipe = recipe_of(settings)
        self._predictor = Predictor(saved, settings, accelerator)

    @classmethod
    def load(cls, run: str | Path | None = None, **options: Any) -> Matcher:
        """Of a run folder; None: the network that comes with the repository, trained on bodies."""
        return cls(read_checkpoint(Path(run or SHIPPED) / BEST), **options)

    def label(self, scan: Scan) -> Labels:
        """Errors: MeshError for a mesh that can't be described."""
        mesh = unit(scan.mesh)
        if self._resamples(len(mesh.vertices)):
            coarse = resample(mesh, self._resolution)
            template, confidence = self._predict(coarse.mesh)
            most = coarse.corners[np.arange(len(mesh.vertices)), coarse.weights.argmax(axis=1)]
            points = self._blend(template[coarse.corners], coarse.weights, template[most])
            template, confidence = template[most], confidence[most]
        else:
            template, confidence = self._predict(mesh)
            points = self.template.vertices[template]
        nowhere = scan.place < 0
        template, confidence, points = (x[scan.place] for x in (template, confidence, points))
        template[nowhere], confidence[nowhere], points[nowhere] = -1, 0.0, np.nan
        return Labels(template.astype(np.int32), points, confidence)

    def match(self, source: Scan, target: Scan) -> Match:
        """Errors: MeshError for a mesh that can't be described."""
        labels = self.label(source), self.label(target)
        return Match(nearest(*labels), *labels)

    def _resamples(self, vertices: int) -> bool:
        if self._resampled is not None:
            return self._resampled
        alike = ALIKE_PATCHES if self._recipe.patch else ALIKE_SPIRALS
        return not self._resolution / alike <= vertices <= self._resolution * alike

    def _predict(self, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
        tasks = descriptor_task(mesh, self._recipe), neighbourhood_task(mesh, self._recipe)
        described, neighbourhoods = (task.compute(*task.arguments) for task in tasks)
        batch = described_tensors(described, mesh, self._recipe)
        batch |= neighbourhood_tensors(neighbourhoods, mesh, self._recipe)
        batch["index"] = 0
        found = self._predictor(batch, "evaluation")
        template, confidence = found.classes.cpu().numpy(), found.probability
        if self._smooth:
            template = zoomout(*eigenfunctions(mesh, TO), self._eigenfunctions, template)
            batch["labels"] = torch.from_numpy(template)
            confidence = self._predictor(batch, "evaluation").of_label
        return template, confidence.float().cpu().numpy()

    def _blend(self, corners: np.ndarray, weights: np.ndarray, most: np.ndarray) -> np.ndarray:
        """float64 [V, 3]: points on the template, between those of the corners [V, 3] of a face; a
        corner far from the one with the most weight is an error, and left out."""
        places = self.template.vertices
        apart = np.linalg.norm(places[corners] - places[most][:, None], axis=2)
        weights = np.where(apart < self._near, weights, 0.0)
        return np.einsum("vk,vkx->vx", weights, places[corners]) / weights.sum(1, keepdims=True)

    @cached_property
    def _near(self) -> float:
        """Five times the template's mean edge."""
        a, b, c = (self.template.vertices[self.template.faces[:, i]] for i in range(3))
        return 5 * float(np.linalg.norm(np.concatenate([b - a, c - b, a - c]), axis=1).mean())

    @cached_property
    def _eigenfunctions(self) -> np.ndarray:
        return eigenfunctions(unit(self.template), TO)[0]  # of one scale with those of the meshes


def nearest(source: Labels, target: Labels) -> np.ndarray:
    """int32 [V]: for every vertex of the source the one of the target that is nearest to it on the
    template; of several at one place the one with the most confidence; -1 where there is none."""
    match = np.full(len(source.template), -1, dtype=np.int32)
    there = np.flatnonzero(target.template >= 0)
    there = there[np.argsort(-target.confidence[there], kind="stable")]
    places, first = np.unique(target.points[there], axis=0, return_index=True)
    known = source.template >= 0
    if len(there) and known.any():
        _, found = cKDTree(places).query(source.points[known])
        match[known] = there[first[found]]
    return match


def unit(mesh: Mesh) -> Mesh:
    """The mesh around the origin, with an area of 1: far away or in another unit it is the same."""
    inner = mesh.vertices[mesh.faces].reshape(-1, 3)
    centred = mesh.vertices - (inner.min(axis=0) / 2 + inner.max(axis=0) / 2)
    return Mesh(centred / np.sqrt(mesh.area), mesh.faces, mesh.name)
