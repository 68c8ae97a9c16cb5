"""What `export=` writes of a match: the dense map as a table, a registration, a morph."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import trimesh

from meshspiral.data.files import write_arrays, write_file
from meshspiral.geometry.barycentric import interpolate
from meshspiral.geometry.mesh import Mesh
from meshspiral.matching.dense import dense_map
from meshspiral.matching.job import FileMatch
from meshspiral.matching.morph import morph_glb
from meshspiral.matching.pictures import align_to_template, own_colors
from meshspiral.matching.registration import registered
from meshspiral.viz.render import upright

EXPORT_FILES = ("dense.npz", "dense.csv", "registered.ply", "morph.glb")


def write_exports(
    kinds: list[str], match: FileMatch, template: Mesh, up: str, folder: Path
) -> None:
    """Write what was asked for.

    Args:
        kinds: Of "dense", "registered" and "morph"; the first and the last need a target.
        match: The match.
        template: The template of the labels.
        up: The template's axis that points up.
        folder: Where to write; it exists.
    """
    if "dense" in kinds:
        write_dense(match, template, folder)
    if "registered" in kinds:
        positions, confidence = registered(match.source, template)
        mesh = trimesh.Trimesh(positions, template.faces, process=False)
        mesh.vertex_attributes["confidence"] = confidence.astype(np.float32)
        write_file(folder / "registered.ply", mesh.export(file_type="ply"))
    if "morph" in kinds:
        write_file(folder / "morph.glb", morph_of(match, template, up))


def write_dense(match: FileMatch, template: Mesh, folder: Path) -> None:
    """Write dense.npz and dense.csv: a target point for every source vertex."""
    corners, weights = dense_map(match.source, match.target, template)
    known = corners[:, 0] >= 0
    points = np.full((len(corners), 3), np.nan)
    points[known] = interpolate(match.target.scan.vertices, corners[known], weights[known])
    write_arrays(
        folder / "dense.npz",
        corners=corners,
        weights=weights,
        points=points,
        confidence=match.confidence,
    )
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["source", "a", "b", "c", "wa", "wb", "wc", "x", "y", "z", "confidence"])
    rows = zip(corners.tolist(), weights, points, match.confidence, strict=True)
    for vertex, (face, bary, point, sure) in enumerate(rows):
        numbers = [f"{value:.6g}" for value in (*bary, *point, sure)]
        table.writerow([vertex, *face, *numbers])
    write_file(folder / "dense.csv", text.getvalue())


def morph_of(match: FileMatch, template: Mesh, up: str) -> bytes:
    """The source in the template's pose, turning into the target and back, as GLB."""
    source, target = match.source, match.target
    start = align_to_template(source.scan, source.labels, template).vertices
    aligned = align_to_template(target.scan, target.labels, template).vertices
    corners, weights = dense_map(source, target, template)
    corners, weights = corners[source.scan.origin], weights[source.scan.origin]
    known = corners[:, 0] >= 0
    end = start.copy()
    end[known] = interpolate(aligned, target.scan.vertex_of[corners[known]], weights[known])
    colors = source.on_mesh(own_colors(source.scan))
    faces = source.scan.mesh.faces
    return morph_glb(upright(start, up), upright(end, up), faces, colors)
