"""Matching two meshes: a network labels both with points of a template, which are then compared.

matcher = Matcher.load()
match = matcher.match(scan(*a, "a"), scan(*b, "b"))
match.target[v]  # the vertex of b that corresponds to vertex v of a
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree

from meshspiral.data.datamodule import described_tensors
from meshspiral.data.preprocessing import descriptor_task
from meshspiral.data.scans import Scan
from meshspiral.experiment.run_folder import BEST
from meshspiral.experiment.schema import TrainConfig
from meshspiral.geometry.barycentric import interpolate
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.resample import resample
from meshspiral.geometry.zoomout import TO, eigenfunctions, zoomout
from meshspiral.training.checkpoints import BUNDLED_RUN, config_of, read_checkpoint, template_of
from meshspiral.training.predictor import Predictor

NEAR = 5.0  # mean edges of the template; labels further apart are not interpolated


class Labels(NamedTuple):
    """What a network predicts for the V vertices of a mesh.

    Attributes:
        template: int32 [V], the corresponding vertex of the template; -1 at a vertex on no face.
        points: float64 [V, 3], the corresponding point on the template, in the template's unit of
            length; NaN at a vertex on no face.
        confidence: float32 [V], the predicted probability of `template`, in 0..1; 0 at a vertex on
            no face.
    """

    template: np.ndarray
    points: np.ndarray
    confidence: np.ndarray


class Match(NamedTuple):
    """A map from the V vertices of a source to the vertices of a target.

    Attributes:
        target: int32 [V], the corresponding vertex of the target; -1 for none.
        source_labels: The labels of the source.
        target_labels: The labels of the target.
    """

    target: np.ndarray
    source_labels: Labels
    target_labels: Labels


class Matcher:
    """A trained network with its template. `Matcher.load` makes one from a run folder.

    Args:
        saved: From `read_checkpoint`.
        config: Its config, from `config_of`.
        accelerator: "cpu" or "gpu".
        resampled: True: resample every mesh to the density of the training meshes, and interpolate
            the labels. False: never. None: only a mesh with so many more or fewer vertices that it
            is outside the `density_range` of the network's neighbourhood.
        smooth: Refine the labels of every mesh by ZoomOut (Melzi et al. 2019).

    Attributes:
        template: The mesh whose vertices and points are the labels.
        up: The template's axis that points up, "y" or "z".

    Raises:
        RunError: The checkpoint has no template, or its weights do not fit its config.
        ConfigError: There is no GPU.
    """

    def __init__(
        self,
        saved: dict[str, Any],
        config: TrainConfig,
        accelerator: str = "cpu",
        resampled: bool | None = None,
        smooth: bool = False,
    ):
        self.template = template_of(saved)
        self.up = saved["up"]
        self._training_size = int(saved["resolution"])  # vertices of a training mesh
        self._resampled, self._smooth = resampled, smooth
        self._shot = config.data.shot
        self._predictor = Predictor(saved, config, accelerator)

    @classmethod
    def load(cls, run: str | Path | None = None, **options: Any) -> Matcher:
        """The matcher of a run folder.

        Args:
            run: The run folder; only checkpoints/best.ckpt is read. None: the bundled network,
                trained on complete human bodies.
            **options: `accelerator`, `resampled` and `smooth` of the class.

        Raises:
            RunError: The checkpoint is missing or damaged, has no template, or needs a plugin.
            ConfigError: There is no GPU.
        """
        folder = Path(run or BUNDLED_RUN)
        saved = read_checkpoint(folder / BEST)
        return cls(saved, config_of(saved, str(folder)), **options)

    def label(self, scan: Scan) -> Labels:
        """Label a mesh with vertices and points of the template.

        Args:
            scan: From `open_scan` or `scan`.

        Returns:
            The labels of the user's vertices.

        Raises:
            MeshError: The mesh cannot be described, resampled or smoothed.
        """
        mesh = normalize(scan.mesh)
        if self._needs_resampling(len(mesh.vertices)):
            coarse = resample(mesh, self._training_size)
            template, confidence = self._predict(coarse.mesh)
            nearest = coarse.corners[np.arange(len(mesh.vertices)), coarse.weights.argmax(axis=1)]
            points = self._interpolate(template[coarse.corners], coarse.weights, template[nearest])
            template, confidence = template[nearest], confidence[nearest]
        else:
            template, confidence = self._predict(mesh)
            points = self.template.vertices[template]
        missing = scan.vertex_of < 0
        template, confidence, points = (x[scan.vertex_of] for x in (template, confidence, points))
        template[missing], confidence[missing], points[missing] = -1, 0.0, np.nan
        return Labels(template.astype(np.int32), points, confidence)

    def match(self, source: Scan, target: Scan) -> Match:
        """Map the vertices of a source to those of a target.

        Raises:
            MeshError: A mesh cannot be described, resampled or smoothed.
        """
        labels = self.label(source), self.label(target)
        return Match(nearest_vertices(*labels), *labels)

    def _needs_resampling(self, vertices: int) -> bool:
        if self._resampled is not None:
            return self._resampled
        factor = self._predictor.neighbourhood.density_range
        return not self._training_size / factor <= vertices <= self._training_size * factor

    def _predict(self, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
        """Predict for each vertex of a mesh a template vertex and its probability.

        Args:
            mesh: W vertices, normalized.

        Returns:
            Vertices of the template, int64 [W], and their probabilities, float32 [W].
        """
        descriptors = descriptor_task(mesh, self._shot)
        neighbourhood = self._predictor.neighbourhood
        batch = described_tensors(descriptors.compute(*descriptors.arguments), mesh, self._shot)
        batch |= neighbourhood.tensors(neighbourhood.compute(mesh), mesh)
        batch["index"] = 0
        prediction = self._predictor(batch, "evaluation")
        template, confidence = prediction.classes.cpu().numpy(), prediction.probability
        if self._smooth:
            template = zoomout(*eigenfunctions(mesh, TO), self._eigenfunctions, template)
            batch["labels"] = torch.from_numpy(template)
            confidence = self._predictor(batch, "evaluation").of_label
        return template, confidence.float().cpu().numpy()

    def _interpolate(
        self, corners: np.ndarray, weights: np.ndarray, nearest: np.ndarray
    ) -> np.ndarray:
        """Interpolate the labels of the corners of a face.

        A label further than NEAR mean edges from `nearest` is an error and is left out.

        Args:
            corners: int [V, 3], labels of the corners.
            weights: float64 [V, 3], barycentric coordinates in the face.
            nearest: int [V], the label of the corner with the largest weight.

        Returns:
            float64 [V, 3], points near or on the template.
        """
        vertices = self.template.vertices
        distances = np.linalg.norm(vertices[corners] - vertices[nearest][:, None], axis=2)
        weights = np.where(distances < self._near, weights, 0.0)
        return interpolate(vertices, corners, weights) / weights.sum(1, keepdims=True)

    @cached_property
    def _near(self) -> float:
        a, b, c = (self.template.vertices[self.template.faces[:, i]] for i in range(3))
        edges = np.concatenate([b - a, c - b, a - c])
        return NEAR * float(np.linalg.norm(edges, axis=1).mean())

    @cached_property
    def _eigenfunctions(self) -> np.ndarray:
        """float64 [K, TO], those of the template, at the scale of the meshes."""
        return eigenfunctions(normalize(self.template), TO)[0]


def nearest_vertices(source: Labels, target: Labels) -> np.ndarray:
    """The target vertex whose point on the template is nearest, for every source vertex.

    Args:
        source: Labels of V vertices.
        target: Labels on the same template.

    Returns:
        int32 [V]; of several target vertices at one point the one with the highest confidence; -1
        where the source vertex or every target vertex has no label.
    """
    match = np.full(len(source.template), -1, dtype=np.int32)
    labelled = np.flatnonzero(target.template >= 0)
    labelled = labelled[np.argsort(-target.confidence[labelled], kind="stable")]
    points, first = np.unique(target.points[labelled], axis=0, return_index=True)
    known = source.template >= 0
    if len(labelled) and known.any():
        _, nearest = cKDTree(points).query(source.points[known])
        match[known] = labelled[first[nearest]]
    return match


def normalize(mesh: Mesh) -> Mesh:
    """The mesh with its bounding box centred at the origin, scaled to an area of 1.

    Results then do not depend on the mesh's position and unit of length.
    """
    used = mesh.vertices[mesh.faces].reshape(-1, 3)
    centred = mesh.vertices - (used.min(axis=0) / 2 + used.max(axis=0) / 2)  # the sum may overflow
    return Mesh(centred / np.sqrt(mesh.area), mesh.faces, mesh.name)
