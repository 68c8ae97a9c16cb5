"""Renders of a match: correspondences and confidences."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from meshspiral.data.files import write_file
from meshspiral.data.scans import Scan
from meshspiral.geometry.holes import has_large_holes
from meshspiral.geometry.mesh import Mesh
from meshspiral.matching.job import FileMatch
from meshspiral.matching.matcher import Labels
from meshspiral.matching.transfer import transfer
from meshspiral.viz.colors import GREY, confidence_colors, point_colors, template_colors
from meshspiral.viz.plots import encoded, picture_figure
from meshspiral.viz.render import RenderError, Row, render

log = logging.getLogger(__name__)


def draw_pictures(folder: Path, match: FileMatch, template: Mesh, up: str, required: bool) -> None:
    """Render correspondence.png and confidence.png.

    Both show the target, or the template without one, and beside it the source, in the template's
    pose. The confidence is that of the map at the source, and that of the labels at the target.

    Args:
        folder: Where to write them.
        match: What to show.
        template: The template of the labels.
        up: The template's axis that points up, "y" or "z".
        required: Whether a failure is an error; otherwise a warning says that renders are skipped.

    Raises:
        RenderError: Rendering failed, and the pictures are required.
    """
    source, target = match.source, match.target
    if target:
        target_colors = own_colors(target.scan)
        source_colors = transfer(target_colors, match.map, GREY)
        colors = [target.on_mesh(target_colors), source.on_mesh(source_colors)]
        meshes = [align_to_template(*each[:2], template) for each in (target, source)]
        confidences = [target.on_mesh(target.labels.near_confidence)]
    else:
        source_colors = point_colors(template, source.labels.points)
        colors = [template_colors(template), source.on_mesh(source_colors)]
        meshes = [template, align_to_template(*source[:2], template)]
        confidences = [np.ones(len(template.vertices))]
    confidences.append(source.on_mesh(match.source_confidence))
    rows = [Row(meshes, colors), Row(meshes, [confidence_colors(c) for c in confidences])]
    try:
        correspondence, confidence = render(rows, up)
    except RenderError as error:
        if required:
            raise
        log.warning("skipping renders: %s", error)
        return
    captions = ["target" if target else "template", "source"]
    figures = {
        "correspondence": picture_figure(*correspondence, captions),
        "confidence": picture_figure(*confidence, captions, bar="confidence"),
    }
    for name, figure in figures.items():
        write_file(folder / f"{name}.png", encoded(figure, "png"))


def own_colors(scan: Scan) -> np.ndarray:
    """Colours of a user's vertices by their own coordinates, float [V, 3]: smooth over the mesh.

    Carried to another mesh by a map, they show where the map is wrong.
    """
    return point_colors(scan.mesh, scan.vertices)


def align_to_template(scan: Scan, labels: Labels, template: Mesh) -> Mesh:
    """The mesh of a scan, scaled, translated and rotated to fit its labels on the template.

    The mesh gets the template's area, or if it has large holes, the extent of its labels. The
    rotation is the best in the sense of least squares, weighted by confidence (Kabsch 1976).
    """
    mesh, points = scan.mesh, labels.points[scan.origin]
    weights = labels.confidence[scan.origin] + 1e-6  # never all zero
    vertices = mesh.vertices - np.average(mesh.vertices, axis=0, weights=weights)
    centred_points = points - np.average(points, axis=0, weights=weights)
    if has_large_holes(mesh):
        extents = [np.average((x**2).sum(1), weights=weights) for x in (centred_points, vertices)]
        vertices *= np.sqrt(extents[0] / extents[1])
    else:
        vertices *= template.size / mesh.size
    rotation, _ = Rotation.align_vectors(centred_points, vertices, weights)
    return Mesh(rotation.apply(vertices), mesh.faces, mesh.name)
