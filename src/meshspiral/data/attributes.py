"""Reading of colours, texture coordinates and other values of the vertices of a mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from meshspiral.data.mesh_files import load_parts, obj_statements, read_arrays
from meshspiral.data.shapes import DataError

KINDS = ("color", "uv")


def read_attribute(path: str | Path, what: str, vertices: int) -> np.ndarray:
    """Read an attribute of the vertices of a mesh.

    Where an OBJ has several texture coordinates for one vertex, at a seam, the first counts.

    Args:
        path: The mesh file.
        what: "color" or "uv" to read it from the mesh file; otherwise the path of a .npy file.
        vertices: Number of vertices V of the mesh.

    Returns:
        uint8 [V, 3] for "color"; float64 [V, 2] for "uv", NaN at isolated vertices of an OBJ;
        otherwise the array of the .npy file, numbers [V, ...].

    Raises:
        DataError: The attribute is missing, unreadable, or not given for all V vertices.
        MeshError: The mesh file is unreadable, as in `read_mesh`.
    """
    path = Path(path)
    if what not in KINDS:
        values = _from_array(Path(what))
    elif path.suffix.lower() == ".obj":
        values = _from_obj(path, what)
    else:
        values = _from_parts(path, what)
    if values is None or (what in KINDS and len(values) == 0):
        raise DataError(f"{path}: its vertices have no {what}, so there is none to transfer")
    if len(values) != vertices:
        raise DataError(
            f"{path if what in KINDS else what}: {len(values)} values of {what} for "
            f"{vertices} vertices"
        )
    return values


def _from_array(path: Path) -> np.ndarray:
    """The numbers in a .npy file."""
    if path.suffix != ".npy":
        raise DataError(f"transfer must be {', '.join(KINDS)}, or a .npy file; got {path}")
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DataError(f"{path}: no array that can be read ({error})") from error
    if not isinstance(values, np.ndarray) or values.ndim == 0 or values.dtype.kind not in "biufc":
        raise DataError(f"{path}: must be an array of numbers, one row per vertex")
    return values


def _from_parts(path: Path, what: str) -> np.ndarray | None:
    """The attribute as trimesh reads it; None if a part of the file has none."""
    read_arrays(path)  # raises MeshError if the file is damaged
    parts = load_parts(path.read_bytes(), path.suffix.lower())
    values = [_from_visual(part.visual, what) for part, _ in parts]
    return None if any(value is None for value in values) else np.concatenate(values)


def _from_visual(visual, what: str) -> np.ndarray | None:
    """The attribute of one part, from its trimesh visual; None if it has none."""
    if what == "uv":
        return getattr(visual, "uv", None)
    if visual.kind == "texture" and visual.uv is not None:
        images = (getattr(visual.material, name, None) for name in ("image", "baseColorTexture"))
        if any(image is not None for image in images):
            visual = visual.to_color()
    return visual.vertex_colors[:, :3] if visual.kind == "vertex" else None


def _from_obj(path: Path, what: str) -> np.ndarray | None:
    """The attribute in an OBJ file; None if it has none.

    trimesh would split vertices at seams.
    """
    vertices: list[list[str]] = []
    textures: list[list[str]] = []
    first: dict[int, int | None] = {}  # per vertex on a face: index of its texture coordinates
    try:
        for keyword, words in obj_statements(path.read_bytes()):
            if keyword == "v":
                vertices.append(words)
            elif keyword == "vt":
                textures.append(words[:2])
            else:
                for vertex, texture in words:
                    first.setdefault(_index(vertex), _index(texture) if texture else None)
        if what == "color":
            if not all(len(vertex) >= 6 for vertex in vertices):
                return None
            values = np.array([vertex[3:6] for vertex in vertices], dtype=float)
            scale = 255 if values.max() <= 1 else 1  # some programs write 0..1, some 0..255
            return np.round(scale * values).clip(0, 255).astype(np.uint8)
        known = {vertex: texture for vertex, texture in first.items() if texture is not None}
        if not known:
            return None
        values = np.full((len(vertices), 2), np.nan)
        values[list(known)] = np.array(textures, dtype=float)[list(known.values())]
    except (ValueError, IndexError, OSError) as error:
        raise DataError(f"{path}: its {what} cannot be read ({error})") from error
    if missing := len(first) - len(known):
        raise DataError(f"{path}: {missing:,} of the {len(first):,} vertices of faces have no uv")
    return values


def _index(word: str) -> int:
    """The index, from 0, that an absolute number in an OBJ file means."""
    number = int(word)
    if number < 1:
        raise ValueError(f"numbers count from 1, got {number}")
    return number - 1
