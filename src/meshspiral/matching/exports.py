"""Files with what was found of a user's mesh, each whole or not there."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from meshspiral.data.scans import Scan
from meshspiral.experiment.runs import write_whole


def write_lines(path: Path, numbers: np.ndarray) -> None:
    """A text file with a whole number a line."""
    write_whole(path, "\n".join(map(str, numbers.tolist())) + "\n")


def _mesh(scan: Scan, **visual: Any) -> trimesh.Trimesh:
    """The user's own vertices, and those of their faces that can be drawn."""
    faces = scan.faces[((scan.faces >= 0) & (scan.faces < len(scan.vertices))).all(axis=1)]
    return trimesh.Trimesh(scan.vertices, faces, process=False, **visual)


def write_colored(path: Path, scan: Scan, colors: np.ndarray) -> None:
    """The user's mesh as a PLY. colors: float [V, 3] in 0..1."""
    colored = _mesh(scan, vertex_colors=np.round(255 * colors).astype(np.uint8))
    write_whole(path, colored.export(file_type="ply"))


def write_carried(folder: Path, scan: Scan, values: np.ndarray, what: str) -> None:
    """transferred.npy, and with colours transferred.ply, with uv transferred.obj."""
    whole = io.BytesIO()
    np.save(whole, values)
    write_whole(folder / "transferred.npy", whole.getvalue())
    if what == "color":
        write_whole(
            folder / "transferred.ply", _mesh(scan, vertex_colors=values).export(file_type="ply")
        )
    if what == "uv":
        textured = _mesh(scan, visual=trimesh.visual.TextureVisuals(uv=values))
        text = trimesh.exchange.obj.export_obj(textured, include_normals=False, write_texture=False)
        write_whole(folder / "transferred.obj", text)
