"""The triangle mesh: its checks, area, normals and renumbering."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from meshspiral.geometry.faces import directed_edges


class MeshError(ValueError):
    """A mesh or mesh file that cannot be used. The message names it, the rule and the values."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """An oriented triangle mesh whose edges have one or two faces each.

    Boundaries, several components, isolated vertices, zero-area faces and bow ties (vertices where
    several fans of faces meet) are allowed.

    Args:
        vertices: float64 [V, 3], coordinates in any unit of length.
        faces: int32 [F, 3], vertex indices, counter-clockwise as seen from outside.
        name: Used in messages.
        complete_area: Area of the complete surface, of which the mesh shows a part; None: its own.

    Raises:
        MeshError: The shapes or types are wrong; there is no vertex; a coordinate is not finite; a
            face names a vertex outside 0..V-1 or one vertex twice; an edge has more than two faces;
            or two neighbouring faces are wound against each other.
    """

    vertices: np.ndarray
    faces: np.ndarray
    name: str = "mesh"
    complete_area: float | None = None

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
        """Refuse edges with more than two faces, and neighbouring faces with opposite windings."""
        directed = directed_edges(self.faces).astype(np.int64)
        directed_keys = directed[:, 0] * len(self.vertices) + directed[:, 1]
        if len(np.unique(directed_keys)) == len(directed_keys):
            return  # every directed edge has one face: at most two faces an edge, wound alike
        undirected = np.sort(directed, axis=1)
        keys = undirected[:, 0] * len(self.vertices) + undirected[:, 1]
        unique, first, counts = np.unique(keys, return_index=True, return_counts=True)
        edges = undirected[first]
        _refuse(self.name, counts > 2, edges, "edge", "with more than two faces", numbered=False)
        keys, counts = np.unique(directed_keys, return_counts=True)
        start, tip = np.divmod(keys[counts > 1], len(self.vertices))
        repeated = np.minimum(start, tip) * len(self.vertices) + np.maximum(start, tip)
        _refuse(
            self.name,
            np.isin(unique, repeated),
            edges,
            "edge",
            "whose two faces are wound against each other",
            numbered=False,
        )

    @property
    def centred(self) -> np.ndarray:
        """float64 [V, 3]: the vertices relative to their mean; float32 has no digits left far away
        from the origin."""
        return self.vertices - self.vertices.mean(axis=0)

    @cached_property
    def face_normals(self) -> np.ndarray:
        """float64 [F, 3]: the normal of every face, as long as twice the face's area."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return np.cross(b - a, c - a)

    @cached_property
    def area(self) -> float:
        """The surface area, in the square of the mesh's unit."""
        return float(np.linalg.norm(self.face_normals, axis=1).sum() / 2)

    @cached_property
    def mean_edge(self) -> float:
        """Mean length of the faces' edges in the mesh's unit; an edge of two faces counts twice."""
        corners = self.vertices[self.faces]
        return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())

    @cached_property
    def size(self) -> float:
        """The length to which radii relate: the square root of the complete surface's area."""
        return float(np.sqrt(self.area if self.complete_area is None else self.complete_area))

    @cached_property
    def vertex_areas(self) -> np.ndarray:
        """float64 [V]: a third of the area of the faces around every vertex."""
        areas = np.repeat(np.linalg.norm(self.face_normals, axis=1) / 6, 3)
        return np.bincount(self.faces.ravel(), areas, minlength=len(self.vertices))

    @cached_property
    def vertex_normals(self) -> np.ndarray:
        """float64 [V, 3]: unit normals, the area-weighted mean of the normals of adjacent faces.

        NaN at isolated vertices, and where the faces' normals cancel.
        """
        total = np.zeros_like(self.vertices)
        for corner in range(3):
            np.add.at(total, self.faces[:, corner], self.face_normals)
        with np.errstate(invalid="ignore", divide="ignore"):
            return total / np.linalg.norm(total, axis=1, keepdims=True)

    def renumbered(self, order: np.ndarray) -> Mesh:
        """The same surface with its vertices in another order.

        Args:
            order: int [V], a permutation; vertex i of the result is vertex order[i] of this mesh.

        Returns:
            The renumbered mesh. The order of its faces, and of their corners, is the same.
        """
        inverse = np.empty(len(order), dtype=np.int32)
        inverse[order] = np.arange(len(order), dtype=np.int32)
        return Mesh(self.vertices[order], inverse[self.faces], self.name, self.complete_area)

    def with_faces(self, faces: np.ndarray) -> Mesh:
        """The same vertices with other faces, int [F, 3]."""
        return Mesh(self.vertices, faces, self.name, self.complete_area)


def used_vertices(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The vertices that faces name, and the faces renumbered to these.

    Args:
        faces: int [F, 3], vertex indices.

    Returns:
        The vertices, int [U], ascending; and the faces, int [F, 3], as indices of these.
    """
    used, numbered = np.unique(faces, return_inverse=True)
    return used, numbered.reshape(-1, 3)


def _refuse(name, bad, rows, noun, rule, numbered=True, shown=3):
    """Raise a MeshError with the number of offenders and the first of them, if there are any.

    Args:
        name: Name of the mesh.
        bad: bool [K], whether each row breaks the rule.
        rows: [K, D], the values to show.
        noun: "vertex", "face" or "edge".
        rule: What the offenders have in common.
        numbered: Whether the index of a row identifies it for the user.
        shown: Number of offenders to show.
    """
    offenders = np.flatnonzero(bad)
    if len(offenders) == 0:
        return

    def describe(i):
        values = ", ".join(f"{x:.6g}" for x in rows[i])
        return f"{noun} {i} = ({values})" if numbered else f"({values})"

    plural = {"vertex": "vertices", "face": "faces", "edge": "edges"}[noun]
    count = f"{len(offenders)} {noun if len(offenders) == 1 else plural}"
    first = "; ".join(describe(i) for i in offenders[:shown])
    raise MeshError(f"{name}: {count} {rule}: {first}")
