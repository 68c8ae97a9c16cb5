"""Triangle meshes: read, check, measure."""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

SUFFIXES = (".ply", ".obj", ".off", ".stl", ".glb")


class MeshError(ValueError):
    """A mesh or file that cannot be used; the message names it, the rule and what was found."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """An oriented triangle mesh whose every edge has one or two faces.

    vertices: float64 [V, 3], any unit of length. faces: int32 [F, 3], vertex indices,
    counter-clockwise as seen from outside. name: used in messages.

    Boundaries, several components, vertices without a face, zero-area faces and vertices where
    several fans of faces meet are all allowed. MeshError is raised for: wrong shapes or no
    vertices; coordinates that are not finite; an index outside 0..V-1; a face that names a vertex
    twice; an edge with more than two faces; two neighbouring faces wound against each other.
    """

    vertices: np.ndarray
    faces: np.ndarray
    name: str = "mesh"

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        faces = np.asarray(self.faces)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) == 0:
            raise MeshError(
                f"{self.name}: vertices must be [V, 3] with V > 0, got {vertices.shape}"
            )
        if faces.size == 0:
            faces = faces.reshape(0, 3).astype(np.int32)
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise MeshError(f"{self.name}: faces must be triangles, [F, 3], got {faces.shape}")
        if not np.issubdtype(faces.dtype, np.integer):
            raise MeshError(f"{self.name}: faces must be integers, got {faces.dtype}")
        _refuse(
            self.name,
            ~np.isfinite(vertices).all(1),
            vertices,
            "vertex",
            "with coordinates that are not finite",
        )
        _refuse(
            self.name,
            ((faces < 0) | (faces >= len(vertices))).any(1),
            faces,
            "face",
            f"naming a vertex outside 0..{len(vertices) - 1}",
        )
        faces = np.ascontiguousarray(faces, dtype=np.int32)
        a, b, c = faces.T
        _refuse(self.name, (a == b) | (b == c) | (c == a), faces, "face", "naming a vertex twice")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        self._check_edges()

    def _check_edges(self) -> None:
        directed = self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
        directed_keys = directed[:, 0] * len(self.vertices) + directed[:, 1]
        if len(np.unique(directed_keys)) == len(directed_keys):
            return  # every directed edge has one face: at most two faces an edge, wound alike
        undirected = np.sort(directed, axis=1)
        keys = undirected[:, 0] * len(self.vertices) + undirected[:, 1]
        unique, first, counts = np.unique(keys, return_index=True, return_counts=True)
        edges = undirected[first]
        _refuse(self.name, counts > 2, edges, "edge", "with more than two faces", number=False)
        twice = np.unique(directed_keys, return_counts=True)
        start, tip = np.divmod(twice[0][twice[1] > 1], len(self.vertices))
        bad = np.minimum(start, tip) * len(self.vertices) + np.maximum(start, tip)
        _refuse(
            self.name,
            np.isin(unique, bad),
            edges,
            "edge",
            "whose two faces are wound against each other",
            number=False,
        )

    @cached_property
    def face_normals(self) -> np.ndarray:
        """float64 [F, 3]: normal of each face, its length twice the face's area."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return np.cross(b - a, c - a)

    @cached_property
    def area(self) -> float:
        """Surface area, in the square of the mesh's unit."""
        return float(np.linalg.norm(self.face_normals, axis=1).sum() / 2)

    @cached_property
    def vertex_normals(self) -> np.ndarray:
        """float64 [V, 3]: unit normals, the area-weighted mean of the faces' normals.

        NaN at a vertex without a face, or whose faces' normals cancel.
        """
        total = np.zeros_like(self.vertices)
        for corner in range(3):
            np.add.at(total, self.faces[:, corner], self.face_normals)
        with np.errstate(invalid="ignore", divide="ignore"):
            return total / np.linalg.norm(total, axis=1, keepdims=True)

    def renumbered(self, order: np.ndarray) -> Mesh:
        """The same surface with vertex order[i] of this mesh as vertex i. order: int [V]."""
        inverse = np.empty(len(order), dtype=np.int32)
        inverse[order] = np.arange(len(order), dtype=np.int32)
        return Mesh(self.vertices[order], inverse[self.faces], self.name)


def in_use(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The vertices that faces [F, 3] name, int [U], ascending; and the faces numbered by these."""
    used, numbered = np.unique(faces, return_inverse=True)
    return used, numbered.reshape(-1, 3)


def _refuse(name, bad, rows, what, rule, number=True, shown=3):
    """Raise MeshError with the count and the first offenders, if any of `bad` [K] is set."""
    where = np.flatnonzero(bad)
    if len(where) == 0:
        return

    def show(i):
        values = ", ".join(f"{x:.6g}" for x in rows[i])
        return f"{what} {i} = ({values})" if number else f"({values})"

    plural = {"vertex": "vertices", "face": "faces", "edge": "edges"}[what]
    first = "; ".join(show(i) for i in where[:shown])
    raise MeshError(f"{name}: {len(where)} {what if len(where) == 1 else plural} {rule}: {first}")


def read_mesh(path: str | Path) -> Mesh:
    """Read a triangle mesh from a PLY, OBJ, OFF, STL or GLB file.

    Vertices keep the file's order and number, also those that no face names; polygons are
    triangulated. An OBJ's texture coordinates, normals, groups and materials are left aside, since
    they would split vertices. STL has no vertices, only the corners of triangles: corners at equal
    coordinates become one vertex, numbered as they first appear. The parts of a GLB's scene become
    one mesh, each in its place, one after the other.

    Errors: MeshError, with the path, for a file that is missing, unreadable, empty, of another
    format, a point cloud, or that fails the checks of `Mesh`.
    """
    return Mesh(*read_arrays(path), str(path))


def parse_mesh(data: bytes, suffix: str, name: str) -> Mesh:
    """`read_mesh` for the bytes of a file already in memory, say out of an archive."""
    return Mesh(*parse_arrays(data, suffix, name), name)


def read_arrays(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [F, 3] as they are in a file, without the checks of `Mesh`.

    Errors: MeshError for a file that `read_mesh` could not read either.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise MeshError(f"{path}: not a mesh format I read; known are {', '.join(SUFFIXES)}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise MeshError(f"{path}: {error.strerror or error}") from error
    return parse_arrays(data, suffix, str(path))


def parse_arrays(data: bytes, suffix: str, name: str) -> tuple[np.ndarray, np.ndarray]:
    """`read_arrays` for the bytes of a file already in memory."""
    if not data:
        raise MeshError(f"{name}: the file is empty")
    try:
        if suffix == ".obj":
            data = _only_vertices_and_faces(data)
        parts = [_placed(mesh, matrix) for mesh, matrix in load_parts(data, suffix)]
    except Exception as error:  # whatever a parser raises on a damaged file
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise MeshError(f"{name}: not a readable {suffix[1:].upper()} file ({reason})") from error
    if not parts:
        raise MeshError(f"{name}: the file holds no triangle mesh (no faces)")
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([faces + start for (_, faces), start in zip(parts, first, strict=False)])
    if suffix == ".stl":
        _, first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
        order = np.argsort(first)
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        vertices, faces = vertices[first[order]], rank[inverse.reshape(-1)][faces]
    return vertices, faces


def load_parts(data: bytes, suffix: str) -> list[tuple]:
    """What trimesh reads of a file: each triangle mesh, and the matrix that puts it in its place,
    or None. Errors: any."""
    import trimesh  # slow to import, and not needed by a run whose tensors are all on disk

    if suffix == ".ply":
        data = _without_texture(data)
    loaded = trimesh.load(
        io.BytesIO(data), file_type=suffix[1:], process=False, maintain_order=True
    )
    if not hasattr(loaded, "geometry"):
        found = [(loaded, None)]
    else:
        places = [loaded.graph[node] for node in sorted(loaded.graph.nodes_geometry)]
        found = [(loaded.geometry[name], matrix) for matrix, name in places]
    return [(mesh, matrix) for mesh, matrix in found if len(getattr(mesh, "faces", []))]


def _placed(mesh, matrix) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a part, in its place."""
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    if matrix is not None and not np.array_equal(matrix, np.eye(4)):
        vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    return vertices, np.asarray(mesh.faces)


def _without_texture(ply: bytes) -> bytes:
    """A PLY whose faces' texture coordinates have another name: trimesh would give each corner of a
    face a vertex of its own for them."""
    end = ply.find(b"end_header")
    header = ply[: max(end, 0)].replace(b"TextureFile", b"texture").replace(b"texcoord", b"corners")
    return header + ply[max(end, 0) :]


def _only_vertices_and_faces(obj: bytes) -> bytes:
    """An OBJ's `v` lines, then its `f` lines with plain, positive vertex indices.

    A negative index counts back from the last vertex above its line.
    """
    text = obj.decode("utf-8", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ")
    vertices, faces = [], []
    for line in text.splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            vertices.append(line)
        elif kind == "f":
            corners = [word.split("/")[0] for word in words]
            if "-" in line:
                corners = [str(len(vertices) + 1 + int(c)) if c[:1] == "-" else c for c in corners]
            faces.append("f " + " ".join(corners))
    return ("\n".join(vertices + faces) + "\n").encode()
