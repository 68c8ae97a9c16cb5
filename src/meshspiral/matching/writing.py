"""The files of a match: each is written whole or not at all, match.npz last."""

from __future__ import annotations

import io
import logging
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from plotly.offline import get_plotlyjs

from meshspiral.data.files import write_arrays, write_file
from meshspiral.data.scans import Scan
from meshspiral.data.shapes import DataError
from meshspiral.geometry.mesh import Mesh, MeshError
from meshspiral.matching.dense import carried
from meshspiral.matching.export import EXPORT_FILES, write_exports
from meshspiral.matching.job import FileMatch, MatchJob
from meshspiral.matching.pictures import draw_pictures, own_colors
from meshspiral.matching.transfer import transfer
from meshspiral.matching.viewer import Carried, sides_of, thumbnail, view_html
from meshspiral.viz.colors import GREY, point_colors, value_colors

log = logging.getLogger(__name__)
RESULT, THUMBNAIL = "match.npz", "match_thumbnail.png"
SCRIPT = "plotly.min.js"  # of the pages of many matches, in the folder of all
TARGET_FILES = ("target.npz", "target.ply")
SOURCE_FILES = (
    RESULT,
    "map.txt",
    "template.txt",
    "remarks.txt",
    "source.ply",
    "transferred.npy",
    "transferred.ply",
    "transferred.obj",
    "correspondence.png",
    "confidence.png",
    "view.html",
    THUMBNAIL,
    *EXPORT_FILES,
)


def write_match(job: MatchJob, match: FileMatch, folder: Path) -> None:
    """Write the files of a match, and delete those of an earlier one.

    Args:
        job: The job of the match.
        match: What to write.
        folder: Created if it is missing.

    Raises:
        DataError: A file would overwrite an input, or the folder has the match of another mesh.
        OSError: A file cannot be written.
        RenderError: A render failed that the command line asked for.
    """
    check_inputs(folder, match.path, *job.inputs)
    _check_owner(folder, match.path)
    folder.mkdir(parents=True, exist_ok=True)
    delete_files(folder, SOURCE_FILES if match.target else SOURCE_FILES + TARGET_FILES)
    template, scan, labels = job.matcher.template, match.source.scan, match.source.labels
    arrays = labels._asdict()
    if match.target:
        arrays |= {"map": match.map, "map_confidence": match.confidence}
        write_integers(folder / "map.txt", match.map)
        colors = transfer(own_colors(match.target.scan), match.map, GREY)
    else:
        colors = point_colors(template, labels.points)
    write_integers(folder / "template.txt", labels.template)
    write_file(folder / "remarks.txt", "\n".join(remark_lines(match)) + "\n")
    write_colored_mesh(folder / "source.ply", scan, colors, match.source_confidence)
    carried_colors = None
    if job.transfer_values is not None:
        values = carried_values(job.transfer_values, match, template, job.config.transfer)
        write_transferred(folder, scan, values, job.config.transfer)
        carried_colors = colors_of_values(job.transfer_values, values, match, job.config.transfer)
    write_exports(job.config.export, match, template, job.matcher.up, folder)
    if job.with_page:
        write_page(job, match, folder, carried_colors)
    if job.render:
        required = job.config.picture is True
        draw_pictures(folder, match, template, job.matcher.up, required)
    origin = {"key": np.array(job.key(match.path)), "source": np.array(_absolute(match.path))}
    write_arrays(folder / RESULT, **origin, **arrays)  # the last file: now the match is complete


def write_page(job: MatchJob, match: FileMatch, folder: Path, carried: Carried | None) -> None:
    """Write view.html, and for one of many sources its thumbnail.

    For one of many, a mesh that cannot be shown is a warning.
    """
    template, up, one_of_many = job.matcher.template, job.matcher.up, bool(job.config.sources)
    try:
        sides = sides_of(match, template, carried)
    except (MeshError, ValueError) as error:
        if not one_of_many:
            raise
        log.warning("%s: no view.html: %s", match.path, error)
        return
    script = f"../{SCRIPT}" if one_of_many else None
    write_file(folder / "view.html", view_html(sides, match, template, up, script))
    if one_of_many:
        write_file(folder / THUMBNAIL, thumbnail(sides, up))


def write_script(folder: Path) -> None:
    """Write what the pages of many sources share, into the folder of all of them."""
    folder.mkdir(parents=True, exist_ok=True)
    write_file(folder / SCRIPT, get_plotlyjs())


def write_target(job: MatchJob, folder: Path) -> None:
    """Write target.npz and target.ply, which all sources share.

    Raises:
        DataError: A file would overwrite an input.
        OSError: A file cannot be written.
    """
    check_inputs(folder, *job.inputs)
    folder.mkdir(parents=True, exist_ok=True)
    scan, labels = job.target.scan, job.target.labels
    write_arrays(folder / "target.npz", **labels._asdict())
    write_colored_mesh(folder / "target.ply", scan, own_colors(scan), labels.near_confidence)


def is_finished(job: MatchJob, path: str, folder: Path) -> bool:
    """Whether a folder has the complete match of this source file, with the job's settings."""
    result = _read_result(folder)
    try:
        return result is not None and result == (job.key(path), _absolute(path))
    except MeshError:  # unreadable: reported when it is matched
        return False


def delete_match(folder: Path, path: str) -> None:
    """Delete the match of a source, if the folder has it."""
    result = _read_result(folder)
    if result is not None and result[1] == _absolute(path):
        delete_files(folder, SOURCE_FILES)


def check_inputs(folder: Path, *inputs: str) -> None:
    """Raise DataError if a file to be written to the folder would overwrite an input."""
    outputs = {(folder / name).resolve() for name in SOURCE_FILES + TARGET_FILES}
    for path in inputs:
        if Path(path).resolve() in outputs:
            raise DataError(f"{path} would be overwritten; choose another folder with output=")


def _check_owner(folder: Path, path: str) -> None:
    """Raise DataError if the folder has the match of another mesh."""
    result = _read_result(folder)
    if result is not None and result[1] != _absolute(path):
        raise DataError(
            f"{folder} contains the match of {result[1]}; choose another folder with output="
        )


def _read_result(folder: Path) -> tuple[str, str] | None:
    """The key and the source of the match in a folder; None without a complete one."""
    try:
        with np.load(folder / RESULT, allow_pickle=False) as file:
            return str(file["key"]), str(file["source"])
    except Exception:  # whatever NumPy raises for a missing or damaged file
        return None


def delete_files(folder: Path, names: tuple[str, ...]) -> None:
    """Delete files that may exist."""
    for name in names:
        (folder / name).unlink(missing_ok=True)


def remark_lines(match: FileMatch) -> list[str]:
    """Confidence and remarks of source and target, as lines of text."""
    lines = []
    source_kind = "label" if match.confidence is None else "map"
    for role, labelled, kind, confidence in (
        ("source", match.source, source_kind, match.source_confidence),
        ("target", match.target, "label", match.target and match.target.labels.near_confidence),
    ):
        if labelled is not None:
            scan, labels = labelled.scan, labelled.labels
            confidence = confidence[labels.template >= 0]
            lines.append(
                f"{role}: {scan.mesh.name}, {len(scan.vertices):,} vertices; median {kind} "
                f"confidence {np.median(confidence):.2f}, below 0.5 at "
                f"{100 * (confidence < 0.5).mean():.1f} %"
            )
            if count := labels.flipped.sum():
                share = 100 * count / len(confidence)
                lines.append(f"  left and right put back at {count:,} vertices ({share:.1f} %)")
            lines += [f"  {remark}" for remark in scan.remarks]
    return lines


def write_integers(path: Path, integers: np.ndarray) -> None:
    """Write a text file with one integer per line."""
    write_file(path, "\n".join(map(str, integers.tolist())) + "\n")


def write_colored_mesh(path: Path, scan: Scan, colors: np.ndarray, confidence: np.ndarray) -> None:
    """Write the user's mesh as a PLY file with vertex colours and the vertex property confidence.

    Args:
        path: The file.
        scan: The mesh.
        colors: float [V, 3] in 0..1.
        confidence: float32 [V] in 0..1.
    """
    mesh = _user_mesh(scan, vertex_colors=np.round(255 * colors).astype(np.uint8))
    mesh.vertex_attributes["confidence"] = confidence
    write_file(path, mesh.export(file_type="ply"))


def carried_values(values: np.ndarray, match: FileMatch, template: Mesh, kind: str) -> np.ndarray:
    """The target's values on the source: interpolated in faces if that makes sense.

    Args:
        values: [W, ...], one row per target vertex.
        match: With a target.
        template: The template of the labels.
        kind: What is transferred, as `transfer=` says. Colours and floating-point numbers are
            interpolated; whole numbers and truth values, which may be names of parts, are those of
            the nearest vertex.

    Returns:
        [V, ...], with the dtype of `values`.
    """
    if kind != "color" and not np.issubdtype(values.dtype, np.floating):
        return transfer(values, match.map, 0)
    rows = carried(values.reshape(len(values), -1).astype(np.float64), match, template)
    if kind == "color":
        rows = np.round(rows)
    return rows.reshape(-1, *values.shape[1:]).astype(values.dtype)


def colors_of_values(
    values: np.ndarray, carried: np.ndarray, match: FileMatch, kind: str
) -> tuple[np.ndarray, np.ndarray]:
    """Colours of the target's values and of those carried to the source, for the viewer.

    Args:
        values: [W, ...], one row per target vertex.
        carried: [V, ...], from `carried_values`.
        match: With a target.
        kind: What they are, as `transfer=` says.

    Returns:
        float [W, 3] and [V, 3] in 0..1, grey where there is no match.
    """
    if kind == "color":
        target, source = values[:, :3] / 255, carried[:, :3] / 255
    else:
        target, source = value_colors(values, values), value_colors(carried, values)
    return target, np.where(match.map[:, None] < 0, GREY, source)


def write_transferred(folder: Path, scan: Scan, values: np.ndarray, kind: str) -> None:
    """Write transferred.npy; for colours also transferred.ply, for uv also transferred.obj.

    Args:
        folder: Where to write them.
        scan: The source.
        values: Values of its vertices, [V, ...].
        kind: What they are: "color", "uv", or anything else.
    """
    buffer = io.BytesIO()
    np.save(buffer, values)
    write_file(folder / "transferred.npy", buffer.getvalue())
    if kind == "color":
        mesh = _user_mesh(scan, vertex_colors=values)
        write_file(folder / "transferred.ply", mesh.export(file_type="ply"))
    if kind == "uv":
        mesh = _user_mesh(scan, visual=trimesh.visual.TextureVisuals(uv=values))
        text = trimesh.exchange.obj.export_obj(mesh, include_normals=False, write_texture=False)
        lines = text.splitlines()
        # there is no material to name
        kept = [line for line in lines if not line.startswith(("mtllib", "usemtl"))]
        write_file(folder / "transferred.obj", "\n".join(kept) + "\n")


def _user_mesh(scan: Scan, **visual: Any) -> trimesh.Trimesh:
    """The user's own vertices, and those of the user's faces that name existing vertices."""
    faces = scan.faces[((scan.faces >= 0) & (scan.faces < len(scan.vertices))).all(axis=1)]
    return trimesh.Trimesh(scan.vertices, faces, process=False, **visual)


def _absolute(path: str) -> str:
    return str(Path(path).resolve())
