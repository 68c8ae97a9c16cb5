"""Reading of triangle meshes from PLY, OBJ, OFF, STL and GLB files."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from meshspiral.geometry.mesh import Mesh, MeshError

SUFFIXES = (".ply", ".obj", ".off", ".stl", ".glb")


def read_mesh(path: str | Path) -> Mesh:
    """Read a triangle mesh from a PLY, OBJ, OFF, STL or GLB file.

    Vertices keep the order of the file, including isolated ones; polygons are triangulated. Texture
    coordinates, normals, groups and materials of an OBJ are ignored, since they would split
    vertices. STL stores no vertices, only the corners of triangles: corners at equal coordinates
    become one vertex, numbered by their first occurrence. The parts of a GLB's scene are
    transformed to scene coordinates and concatenated.

    Args:
        path: The file.

    Returns:
        The mesh, named by its path.

    Raises:
        MeshError: The file is missing, unreadable, empty, of another format or without faces, or it
            fails the checks of `Mesh`. The message names the path.
    """
    return Mesh(*read_arrays(path), str(path))


def parse_mesh(data: bytes, suffix: str, name: str) -> Mesh:
    """Parse a mesh file that is in memory, for instance from an archive.

    Args:
        data: The content of the file.
        suffix: One of SUFFIXES.
        name: Used in messages.

    Returns:
        The mesh, as `read_mesh` returns it.

    Raises:
        MeshError: As `read_mesh`.
    """
    return Mesh(*parse_arrays(data, suffix, name), name)


def read_arrays(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Read vertices [V, 3] and faces [F, 3] from a file, without the checks of `Mesh`.

    Raises:
        MeshError: The file is missing, unreadable, empty, of another format or without faces.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise MeshError(f"{path}: unknown mesh format; known are {', '.join(SUFFIXES)}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise MeshError(f"{path}: {error.strerror or error}") from error
    return parse_arrays(data, suffix, str(path))


def parse_arrays(data: bytes, suffix: str, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Parse a file in memory like `read_arrays`; the arguments are those of `parse_mesh`."""
    if not data:
        raise MeshError(f"{name}: the file is empty")
    try:
        if suffix == ".obj":
            data = _only_vertices_and_faces(data)
        parts = [_transformed(part, matrix) for part, matrix in load_parts(data, suffix)]
    except Exception as error:  # parsers raise all kinds of errors on damaged files
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise MeshError(f"{name}: not a readable {suffix[1:].upper()} file ({reason})") from error
    if not parts:
        raise MeshError(f"{name}: the file holds no triangle mesh (no faces)")
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([faces + start for (_, faces), start in zip(parts, first, strict=False)])
    return _merged(vertices, faces) if suffix == ".stl" else (vertices, faces)


def load_parts(data: bytes, suffix: str) -> list[tuple]:
    """Load the triangle meshes of a file with trimesh.

    Args:
        data: The content of the file.
        suffix: One of SUFFIXES.

    Returns:
        Each `trimesh.Trimesh` that has faces, and the matrix [4, 4] that transforms it to scene
        coordinates, or None.

    Raises:
        Exception: Of any kind, if the file is damaged.
    """
    import trimesh  # slow to import, and not needed where all arrays are cached

    if suffix == ".ply":
        data = _without_texture(data)
    loaded = trimesh.load(
        io.BytesIO(data), file_type=suffix[1:], process=False, maintain_order=True
    )
    if hasattr(loaded, "geometry"):
        nodes = [loaded.graph[node] for node in sorted(loaded.graph.nodes_geometry)]
        parts = [(loaded.geometry[name], matrix) for matrix, name in nodes]
    else:
        parts = [(loaded, None)]
    return [(part, matrix) for part, matrix in parts if len(getattr(part, "faces", []))]


def obj_statements(data: bytes) -> Iterator[tuple[str, list]]:
    """Parse the statements of an OBJ file that describe vertices, texture coordinates and faces.

    Args:
        data: The content of the file.

    Yields:
        ("v", words), ("vt", words) or ("f", corners), in the order of the file. A corner is a pair
        of words: the numbers, from 1, of its vertex and of its texture coordinates, "" if it has
        none. Relative numbers, which count back from the last statement above (-1), are replaced by
        absolute ones; no word is checked otherwise.

    Raises:
        ValueError: A relative number is not an integer.
    """
    text = data.decode("utf-8", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ")
    counts = {"v": 0, "vt": 0}
    for line in text.splitlines():
        keyword, *words = line.split() or [""]
        if keyword in counts:
            counts[keyword] += 1
            yield keyword, words
        elif keyword == "f":
            yield keyword, [_corner(word, **counts) for word in words]


def _corner(word: str, v: int, vt: int) -> tuple[str, str]:
    """The absolute numbers of a corner of a face, with v `v` and vt `vt` statements above it."""
    vertex, texture = [*word.split("/"), ""][:2]
    if "-" in word:
        vertex = str(v + 1 + int(vertex)) if vertex[:1] == "-" else vertex
        texture = str(vt + 1 + int(texture)) if texture[:1] == "-" else texture
    return vertex, texture


def _only_vertices_and_faces(obj: bytes) -> bytes:
    """An OBJ file reduced to its vertices, followed by its faces with absolute vertex numbers."""
    vertices, faces = [], []
    for keyword, words in obj_statements(obj):
        if keyword == "v":
            vertices.append(f"v {' '.join(words)}")
        elif keyword == "f":
            faces.append(f"f {' '.join(vertex for vertex, _ in words)}")
    return ("\n".join(vertices + faces) + "\n").encode()


def _without_texture(ply: bytes) -> bytes:
    """A PLY file whose texture coordinates of faces are renamed.

    Under their own name trimesh would give every corner of a face its own vertex for them.
    """
    end = max(ply.find(b"end_header"), 0)
    header = ply[:end].replace(b"TextureFile", b"texture").replace(b"texcoord", b"corners")
    return header + ply[end:]


def _transformed(part, matrix) -> tuple[np.ndarray, np.ndarray]:
    """The vertices and faces of a part of a scene, in scene coordinates."""
    vertices = np.asarray(part.vertices, dtype=np.float64)
    if matrix is not None and not np.array_equal(matrix, np.eye(4)):
        vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    return vertices, np.asarray(part.faces)


def _merged(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge the vertices at equal coordinates, numbered by their first occurrence."""
    _, first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return vertices[first[order]], rank[inverse.reshape(-1)][faces]
