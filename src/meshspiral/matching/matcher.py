"""Matching two meshes: a network labels both with points of a template, which are then compared.

matcher = Matcher.load()
match = matcher.match(open_scan("a.ply"), open_scan("b.obj"))
match.target[v]  # the vertex of b that corresponds to vertex v of a
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_array

from meshspiral.data.descriptors import Features
from meshspiral.data.preprocessing import compute_task, descriptor_task, neighbourhood_task
from meshspiral.data.scans import Scan
from meshspiral.data.tensors import described_tensors, neighbourhood_tensors
from meshspiral.evaluation.distributions import (
    SPREAD,
    Distributions,
    near_vertices,
    soft_points,
)
from meshspiral.experiment.run_folder import BEST
from meshspiral.experiment.schema import TrainConfig
from meshspiral.geometry.holes import has_large_holes
from meshspiral.geometry.kdtree import kd_tree
from meshspiral.geometry.mesh import Mesh, MeshError
from meshspiral.geometry.resample import resample, resampled
from meshspiral.geometry.zoomout import TO, eigenfunctions, zoomout
from meshspiral.matching.confidence import (
    RADIUS,
    label_confidence,
    map_confidence,
    near_confidence,
)
from meshspiral.matching.flips import mirror_images, sides_of, without_flips
from meshspiral.matching.mean_field import MeanField, likeliest_near
from meshspiral.training.checkpoints import BUNDLED_RUN, config_of, read_checkpoint, template_of
from meshspiral.training.predictor import Predictor

REFINEMENTS = (None, "crf", "zoomout")
MESH_STAGES = (
    "size",
    "resampling",
    "descriptors",
    "neighbourhoods",
    "network",
    "ensemble",
    "refinement",
)
Report = Callable[[str], None]  # is told each stage when it begins; not every mesh has all
FACTORS = (1.0, 1.1, 1.2, 1.3, 1.45, 1.6, 1.8, 2.1, 2.5)  # tried for the size of an open surface
JUMP = 0.15  # over the template's size: labels of neighbours that are further apart are wrong
JUMPS = 2.0  # how much their share counts against the mean probability of the labels
SEARCHED = 500  # vertices of the mesh on which they are tried, if the network bears so few
UNIT_ERROR = 50.0  # a complete shape of which a mesh is a smaller or larger part has another unit
NEAR = 5.0  # mean edges of the template; labels further apart are not interpolated
# of an ensemble: vertices over those of a training mesh, and size over that of the mesh
COPIES = ((0.72, 0.96), (1.0, 1.0), (1.38, 1.04))


class Labels(NamedTuple):
    """What a network predicts for the V vertices of a mesh.

    Attributes:
        template: int32 [V], the corresponding vertex of the template; -1 at a vertex on no face.
        points: float64 [V, 3], the corresponding point near the template's surface, in the
            template's unit of length: the mean of the vertices around `template`, weighted by their
            predicted probabilities. NaN at a vertex on no face.
        confidence: float32 [V], the predicted probability of `template`, in 0..1; 0 at a vertex on
            no face.
        near_confidence: float32 [V], the predicted probability that the true vertex of the template
            is at most 0.05 sqrt(area) from `template`; 0 at a vertex on no face.
        flipped: bool [V], whether the network took left for right, and the label was moved to the
            other side; False at a vertex on no face.

    On meshes unlike those of training, all probabilities are too high; docs/reliability.md says
    what was measured.
    """

    template: np.ndarray
    points: np.ndarray
    confidence: np.ndarray
    near_confidence: np.ndarray | None = None
    flipped: np.ndarray | None = None


class Match(NamedTuple):
    """A map from the V vertices of a source to the vertices of a target.

    Attributes:
        target: int32 [V], the corresponding vertex of the target; -1 for none.
        source_labels: The labels of the source.
        target_labels: The labels of the target.
        confidence: float32 [V], the predicted probability that the match is right up to 0.05
            sqrt(area) on the template, see `meshspiral.matching.confidence`; 0 for none.
    """

    target: np.ndarray
    source_labels: Labels
    target_labels: Labels
    confidence: np.ndarray


class Matcher:
    """A trained network with its template. `Matcher.load` makes one from a run folder.

    Args:
        saved: From `read_checkpoint`.
        config: Its config, from `config_of`.
        accelerator: "cpu" or "gpu".
        resampled: True: resample every mesh to the density of the training meshes, and interpolate
            the labels. False: never. None: only a mesh with so many more or fewer vertices that it
            is outside the `density_range` of the network's neighbourhood.
        smooth: The same as refine="zoomout".
        refine: "crf": refine the labels of every mesh by those of neighbours, see
            `meshspiral.matching.mean_field`. "zoomout", for complete surfaces: refine them further
            by ZoomOut (Melzi et al. 2019), then take for each vertex the nearby label that the
            network finds likeliest. None: do not refine.
        unflip: Whether parts that took left for right are put back, see
            `meshspiral.matching.flips`; only with a template that is its own mirror image.
        ensemble: Whether to average the scores of the mesh and of three resampled copies, with
            other densities and sizes (COPIES), as geometric means of probabilities. None: with a
            refinement, if the network was trained on remeshed shapes and `resampled` is not False.
        scale: Length of one unit of the meshes in the template's unit; the bundled template is in
            metres. Radii are then those of a body of the template's size. None: they follow from
            the surface area; if a mesh has large holes, the size is sought, see `surest_size`.
        height: Instead of `scale`: how tall the complete shapes are when they stand as the template
            does, in the unit of the meshes. Radii follow in proportion.

    Attributes:
        template: The mesh whose vertices and points are the labels.
        up: The template's axis that points up, "y" or "z".

    Raises:
        RunError: The checkpoint has no template, or its weights do not fit its config.
        ConfigError: There is no GPU.
        ValueError: `refine` is unknown; `scale` or `height` is not positive and finite, or both are
            given.
    """

    def __init__(
        self,
        saved: dict[str, Any],
        config: TrainConfig,
        accelerator: str = "cpu",
        resampled: bool | None = None,
        smooth: bool = False,
        refine: str | None = None,
        unflip: bool = True,
        ensemble: bool | None = None,
        scale: float | None = None,
        height: float | None = None,
    ):
        if refine not in REFINEMENTS:
            raise ValueError(f"refine must be one of {REFINEMENTS}, got {refine!r}")
        for name, value in (("scale", scale), ("height", height)):
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive and finite, got {value}")
        if scale is not None and height is not None:
            raise ValueError(f"give scale or height, not both, got {scale} and {height}")
        self.template = template_of(saved)
        self.up = saved["up"]
        self._training_size = int(saved["resolution"])  # vertices of a training mesh
        self._resampled, self._scale = resampled, scale
        if height is not None:
            self._scale = np.ptp(self.template.vertices[:, "xyz".index(self.up)]) / height
        self._refine = "zoomout" if smooth else refine
        if ensemble is None:
            knows_others = config.data.remesh is not None and resampled is not False
            ensemble = knows_others and self._refine is not None
        self._ensemble = ensemble
        self._mirror = mirror_images(self.template, self.up) if unflip else None
        self._features = Features.of(config.data)
        self._predictor = Predictor(saved, config, accelerator, calibrated=True)

    @classmethod
    def load(cls, run: str | Path | None = None, **options: Any) -> Matcher:
        """The matcher of a run folder.

        Args:
            run: The run folder; only checkpoints/best.ckpt is read. None: the bundled network,
                trained on human bodies.
            **options: `accelerator`, `resampled`, `smooth`, `refine`, `unflip`, `ensemble`, `scale`
                and `height` of the class.

        Raises:
            RunError: The checkpoint is missing or damaged, has no template, or needs a plugin.
            ConfigError: There is no GPU.
            ValueError: `refine` is unknown; `scale` or `height` is not positive, or both are given.
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
            MeshError: The mesh cannot be described, resampled or smoothed, or its size contradicts
                `scale` or `height` by a factor of UNIT_ERROR.
        """
        return self.predict(scan)[0]

    def predict(self, scan: Scan, report: Report | None = None) -> tuple[Labels, Distributions]:
        """Label a mesh, as `label` does; also returns what the labels were chosen from.

        Args:
            scan: From `open_scan` or `scan`.
            report: Called with each of MESH_STAGES that the mesh needs.

        Raises:
            MeshError: The mesh cannot be described, resampled or smoothed.
        """
        report = report or (lambda stage: None)
        mesh = normalize(self._sized(scan.mesh, report))
        if self._needs_resampling(len(mesh.vertices)):
            report("resampling")
            coarse = resample(mesh, self._training_size)
            template, flipped, found = self._predict(coarse.mesh, report)
            points = self._points(template, found)
            nearest = coarse.corners[np.arange(len(mesh.vertices)), coarse.weights.argmax(axis=1)]
            points = self._interpolate(points[coarse.corners], coarse.weights, points[nearest])
            template = self._nearest_vertices(points)
            flipped = flipped[nearest]
        else:
            template, flipped, found = self._predict(mesh, report)
            points, nearest = self._points(template, found), np.arange(len(template))
        missing = scan.vertex_of < 0
        template, points, flipped, row_of = (
            values[scan.vertex_of] for values in (template, points, flipped, nearest)
        )
        template[missing], row_of[missing] = -1, -1
        points[missing], flipped[missing] = np.nan, False
        found = found._replace(row_of=row_of)
        confidence = label_confidence(found, template)
        around = near_confidence(found, template, self._near_vertices)
        return Labels(template.astype(np.int32), points, confidence, around, flipped), found

    def match(self, source: Scan, target: Scan) -> Match:
        """Map the vertices of a source to those of a target.

        Raises:
            MeshError: A mesh cannot be described, resampled or smoothed.
        """
        (labels, found), (target_labels, target_found) = self.predict(source), self.predict(target)
        match = nearest_vertices(labels, target_labels)
        confidence = self.map_confidence(found, target_found, match)
        return Match(match, labels, target_labels, confidence)

    def map_confidence(
        self, source: Distributions, target: Distributions, match: np.ndarray
    ) -> np.ndarray:
        """`confidence` of `Match`, float32 [V].

        Args:
            source: From `predict`, of V vertices.
            target: From `predict`.
            match: int [V], a target vertex for every source vertex; -1 for none.
        """
        return map_confidence(source, target, match, self._near_vertices)

    def _sized(self, mesh: Mesh, report: Report) -> Mesh:
        """The mesh with the area of the complete surface, if it is known or can be found."""
        if self._scale is not None:
            complete = self.template.size / self._scale
            if not 1 / UNIT_ERROR < mesh.size / complete < UNIT_ERROR:
                raise MeshError(
                    f"{mesh.name}: sqrt(area) is {mesh.size:.3g}, but by the given scale or height "
                    f"{complete:.3g} for a complete shape; is this mesh in another unit?"
                )
            return replace(mesh, complete_area=complete**2)
        if not has_large_holes(mesh):
            return mesh
        report("size")
        complete_area = (self.surest_size(mesh) * mesh.size) ** 2
        return replace(mesh, complete_area=complete_area)

    def surest_size(self, mesh: Mesh) -> float:
        """The size of the complete surface at which the network is surest of its labels.

        The mean probability of the labels decides, less twice the share of the edges between whose
        labels the template is torn, on a mesh of few vertices.

        Args:
            mesh: A part of a surface.

        Returns:
            The size of the complete surface over that of the mesh, one of FACTORS.

        Raises:
            MeshError: The mesh cannot be described or resampled.
        """
        mesh = normalize(mesh)
        least = round(self._training_size / self._predictor.neighbourhood.density_range)
        vertices = min(self._training_size, max(SEARCHED, least))
        if len(mesh.vertices) > vertices:
            mesh = resampled(mesh, vertices)
        area, sure = mesh.area, []
        for factor in FACTORS:
            sure.append(self._sureness(normalize(replace(mesh, complete_area=factor**2 * area))))
        return FACTORS[int(np.argmax(sure))]

    def _sureness(self, mesh: Mesh) -> float:
        """How sure the network is of the labels of a mesh, and how smooth they are."""
        found = self._predictor.predict(self._embed(mesh))
        probability = found.probability.float().cpu().numpy()
        points = self.template.vertices[found.classes.cpu().numpy()] / self.template.size
        edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        apart = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
        mean = np.average(probability, weights=mesh.vertex_areas)
        return float(mean - JUMPS * (apart > JUMP).mean())

    def _needs_resampling(self, vertices: int) -> bool:
        if self._resampled is not None:
            return self._resampled
        factor = self._predictor.neighbourhood.density_range
        return not self._training_size / factor <= vertices <= self._training_size * factor

    def _predict(self, mesh: Mesh, report: Report) -> tuple[np.ndarray, np.ndarray, Distributions]:
        """Predict for each vertex of a mesh a template vertex.

        Args:
            mesh: W vertices, normalized.
            report: As for `predict`.

        Returns:
            Vertices of the template, int64 [W], `flipped` of `Labels`, bool [W], and the
            distributions of all W vertices.
        """
        embedding = self._embed(mesh, report)
        if self._ensemble:
            report("ensemble")
            embedding = self._with_copies(mesh, embedding)
        everything = np.arange(len(embedding))
        temperature = self._predictor.temperature
        found = Distributions(embedding, *self._predictor.head, everything, temperature=temperature)
        template = self._predictor.predict(embedding).classes.cpu().numpy()
        flipped = np.zeros(len(template), dtype=bool)
        if self._refine is not None:
            report("refinement")
            template = self._mean_field(found.log_rows(everything), mesh)
        if self._mirror is not None:
            mirrored = without_flips(template, mesh, self.template, self._mirror)
            flipped = mirrored != template
        if flipped.any():
            rows, side = np.flatnonzero(flipped), np.where(flipped, self._sides[mirrored], 0)
            found = found._replace(side=side, sides=self._sides)
            template[rows] = likeliest_near(found.log_rows(rows), mirrored[rows], self.template)
        if self._refine == "zoomout":
            template = zoomout(*eigenfunctions(mesh, TO), self._eigenfunctions, template)
            template = likeliest_near(found.log_rows(everything), template, self.template)
        return template, flipped, found

    def _embed(self, mesh: Mesh, report: Report = lambda stage: None) -> torch.Tensor:
        """The input of the network's last layer, [W, C], for each vertex of a mesh."""
        report("descriptors")
        described = [compute_task(descriptor_task(mesh, d)) for d in self._features.descriptors]
        batch = described_tensors(described, mesh, self._features)
        report("neighbourhoods")
        neighbourhood = self._predictor.neighbourhood
        arrays = compute_task(neighbourhood_task(mesh, neighbourhood))
        batch |= neighbourhood_tensors(mesh, neighbourhood, arrays)
        batch["index"] = 0
        report("network")
        return self._predictor.embed(batch, "evaluation")

    def _with_copies(self, mesh: Mesh, embedding: torch.Tensor) -> torch.Tensor:
        """The mean of the embeddings of a mesh and of COPIES, [W, C].

        The last layer is linear, so its scores are then the mean of theirs.
        """
        total, count = embedding.clone(), 1
        for density, size in COPIES:
            vertices = round(density * self._training_size)
            if vertices == len(mesh.vertices):
                continue
            copy = resample(mesh, vertices)
            described = self._embed(replace(copy.mesh, complete_area=(size * mesh.size) ** 2))
            weights = torch.from_numpy(copy.weights).to(described)
            corners = described[torch.from_numpy(copy.corners).to(described.device)]
            total, count = total + torch.einsum("wk,wkc->wc", weights, corners), count + 1
        return total / count

    def _points(self, template: np.ndarray, found: Distributions) -> np.ndarray:
        """The points of labels, float64 [W, 3], see `soft_points`."""
        return soft_points(found, template, self._spread, self.template.vertices)

    def _interpolate(
        self, corners: np.ndarray, weights: np.ndarray, nearest: np.ndarray
    ) -> np.ndarray:
        """Interpolate the points of the corners of a face.

        A point further than NEAR mean edges from `nearest` is an error and is left out.

        Args:
            corners: float [V, 3, 3], points of the corners.
            weights: float64 [V, 3], barycentric coordinates in the face.
            nearest: float [V, 3], the point of the corner with the largest weight.

        Returns:
            float64 [V, 3], points near or on the template.
        """
        distances = np.linalg.norm(corners - nearest[:, None], axis=2)
        weights = np.where(distances < self._near, weights, 0.0)
        return np.einsum("vc,vcx->vx", weights, corners) / weights.sum(1, keepdims=True)

    def _nearest_vertices(self, points: np.ndarray) -> np.ndarray:
        """The template vertex nearest to each point, int64 [V]."""
        return kd_tree(self.template.vertices).query(points)[1]

    @cached_property
    def _spread(self) -> csr_array:
        return near_vertices(self.template, SPREAD)

    @cached_property
    def _sides(self) -> np.ndarray:
        return sides_of(self.template, self._mirror)

    @cached_property
    def _mean_field(self) -> MeanField:
        return MeanField(self.template)

    @cached_property
    def _near(self) -> float:
        return NEAR * self.template.mean_edge

    @cached_property
    def _near_vertices(self) -> csr_array:
        return near_vertices(self.template, RADIUS)

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
        _, nearest = kd_tree(points).query(source.points[known])
        match[known] = labelled[first[nearest]]
    return match


def normalize(mesh: Mesh) -> Mesh:
    """The mesh with its bounding box centred at the origin, scaled to a size of 1.

    Results then do not depend on the mesh's position and unit of length.
    """
    used = mesh.vertices[mesh.faces].reshape(-1, 3)
    centred = mesh.vertices - (used.min(axis=0) / 2 + used.max(axis=0) / 2)  # the sum may overflow
    return Mesh(
        centred / mesh.size, mesh.faces, mesh.name, None if mesh.complete_area is None else 1.0
    )
