"""What a mesh file says of its vertices beside their place: colours, texture coordinates."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from meshspiral.data.shapes import DataError
from meshspiral.geometry.mesh import load_parts, read_arrays

KINDS = ("color", "uv")


def read_attribute(path: str | Path, what: str, vertices: int) -> np.ndarray:
    """Of a mesh file with so many vertices: "color", uint8 [V, 3], or "uv", float64 [V, 2]; or of
    another file, `what`, an array [V, ...] of numbers in .npy format.

    Where an OBJ has several texture coordinates for one vertex, at a seam, the first counts.
    Errors: DataError if the file has no such thing, or not for each vertex; MeshError as for
    `read_mesh`.
    """
    path = Path(path)
    if what not in KINDS:
        values = _array(Path(what))
    elif path.suffix.lower() == ".obj":
        values = _of_obj(path, what)
    else:
        values = _of_parts(path, what)
    if values is None or (what in KINDS and len(values) == 0):
        raise DataError(f"{path}: its vertices have no {what}, so there is none to transfer")
    if len(values) != vertices:
        raise DataError(
            f"{path if what in KINDS else what}: {len(values)} values of {what} for "
            f"{vertices} vertices"
        )
    return values


def _array(path: Path) -> np.ndarray:
    if path.suffix != ".npy":
        raise DataError(f"transfer must be {', '.join(KINDS)}, or a .npy file; got {path}")
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DataError(f"{path}: no array that can be read ({error})") from error
    if not isinstance(values, np.ndarray) or values.ndim == 0 or values.dtype.kind not in "biufc":
        raise DataError(f"{path}: holds no numbers for vertices")
    return values


def _of_parts(path: Path, what: str) -> np.ndarray | None:
    read_arrays(path)  # says what is wrong with the file
    parts = load_parts(path.read_bytes(), path.suffix.lower())
    values = [_visual(part.visual, what) for part, _ in parts]
    return None if any(value is None for value in values) else np.concatenate(values)


def _visual(visual, what: str) -> np.ndarray | None:
    if what == "uv":
        return getattr(visual, "uv", None)
    if visual.kind == "texture" and visual.uv is not None:
        images = (getattr(visual.material, name, None) for name in ("image", "baseColorTexture"))
        if any(image is not None for image in images):
            visual = visual.to_color()
    return visual.vertex_colors[:, :3] if visual.kind == "vertex" else None


def _of_obj(path: Path, what: str) -> np.ndarray | None:
    vertices: list[list[str]] = []
    textures: list[list[str]] = []
    first: dict[int, int | None] = {}  # of each vertex of a face, its texture coordinates
    try:
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            kind, *words = line.split() or [""]
            if kind == "v":
                vertices.append(words)
            elif kind == "vt":
                textures.append(words[:2])
            elif kind == "f":
                for corner in words:
                    one, texture = [*corner.split("/"), ""][:2]
                    place = _number(texture, textures) if texture else None
                    first.setdefault(_number(one, vertices), place)
        if what == "color":
            if not all(len(vertex) >= 6 for vertex in vertices):
                return None
            values = np.array([vertex[3:6] for vertex in vertices], dtype=float)
            scale = 255 if values.max() <= 1 else 1  # some write 0..1, some 0..255
            return np.round(scale * values).clip(0, 255).astype(np.uint8)
        known = {vertex: place for vertex, place in first.items() if place is not None}
        if not known:
            return None
        values = np.full((len(vertices), 2), np.nan)
        values[list(known)] = np.array(textures, dtype=float)[list(known.values())]
    except (ValueError, IndexError, OSError) as error:
        raise DataError(f"{path}: its {what} can't be read ({error})") from error
    if missing := len(first) - len(known):
        raise DataError(f"{path}: {missing:,} of the {len(first):,} vertices of faces have no uv")
    return values


def _number(word: str, things: list) -> int:
    number = int(word)
    return number - 1 if number > 0 else len(things) + number
