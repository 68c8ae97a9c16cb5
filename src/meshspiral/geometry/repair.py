"""Repair of damaged meshes, with a record of what was changed; and outward orientation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from meshspiral.geometry.faces import directed_edges, without_repeats
from meshspiral.geometry.holes import close_holes
from meshspiral.geometry.mesh import Mesh, MeshError, used_vertices

CLEARLY = 0.05  # share of the volume of a sphere, see `outwards`


class Repaired(NamedTuple):
    """A repaired mesh, and how its vertices correspond to those of the input.

    Attributes:
        mesh: The repaired mesh, with W vertices.
        place: int64 [V], for every vertex of the input its index in the mesh, or -1.
        origin: int64 [W], for every vertex of the mesh its index in the input.
        changes: What was changed, one sentence each.
    """

    mesh: Mesh
    place: np.ndarray
    origin: np.ndarray
    changes: list[str]


def repair(vertices: np.ndarray, faces: np.ndarray, name: str) -> Repaired:
    """Make a mesh that `Mesh` accepts from arrays that it may refuse.

    The steps, in this order:

    1. Remove faces that name a missing or non-finite vertex, or one vertex twice, and faces that
       repeat another.
    2. Join vertices at equal coordinates, and remove the faces that thereby lose their area or
       repeat another.
    3. Cut the surface open along edges with more than two faces.
    4. Turn faces to agree with their neighbours, and cut the surface open along the edges where
       they cannot.
    5. Close small holes, see `close_holes`.

    Args:
        vertices: float [V, 3], coordinates.
        faces: int [F, 3], vertex indices.
        name: Used in messages.

    Returns:
        The mesh and the correspondence of its vertices with the input.

    Raises:
        MeshError: An array does not have three columns, or no usable face is left.
    """
    vertices, faces = np.array(vertices, dtype=np.float64), np.array(faces, dtype=np.int64)
    for array, noun in ((vertices, "vertices"), (faces, "faces")):
        if array.ndim != 2 or array.shape[1] != 3:
            raise MeshError(f"{name}: {noun} must have three columns, got {array.shape}")
    changes: list[str] = []

    def note(count: int, change: str) -> None:
        if count:
            changes.append(f"{count:,} {change}")

    finite = np.isfinite(vertices).all(axis=1)
    inside = ((faces >= 0) & (faces < len(vertices))).all(axis=1)
    faces = faces[inside]
    sound = finite[faces].all(axis=1)
    note(int((~finite).sum()), "vertices with coordinates that are not finite removed")
    note(int((~inside).sum()), "faces removed that name a vertex outside the mesh")
    note(int((~sound).sum()), "faces removed at vertices that are not finite")
    faces = faces[sound]
    before = len(faces)
    faces = without_repeats(faces)
    note(before - len(faces), "faces removed that name a vertex twice or repeat another face")

    joined = _joined(vertices, finite)
    note(
        int((joined != np.arange(len(vertices))).sum()), "vertices joined with others at one point"
    )
    before = len(faces)
    faces = without_repeats(joined[faces])
    note(before - len(faces), "faces removed that collapsed or repeated another after joining")
    if not len(faces):
        raise MeshError(f"{name}: no usable face")

    vertices[~finite] = 0.0
    nonmanifold = _multiplicity(np.sort(directed_edges(faces), axis=1)) > 2
    vertices, faces, origin, cuts = _cut_open(vertices, faces, nonmanifold)
    note(cuts, "edges with more than two faces cut open")
    turned = _turned(vertices, faces)
    note(int((turned != faces).any(axis=1).sum()), "faces turned to agree with their neighbours")
    inconsistent = _multiplicity(directed_edges(turned)) > 1
    vertices, faces, copied, cuts = _cut_open(vertices, turned, inconsistent)
    note(cuts, "edges cut open where faces cannot be turned to agree")
    origin = origin[copied]

    used, faces = used_vertices(faces)
    new_index = np.full(len(joined) + 1, -1)  # the last element is that of index -1
    new_index[origin[used][::-1]] = np.arange(len(used))[::-1]  # the first copy of a vertex counts
    mesh = close_holes(Mesh(vertices[used], faces, name))
    note(len(mesh.faces) - len(faces), "faces added to close holes")
    return Repaired(mesh, new_index[np.where(finite, joined, -1)], origin[used], changes)


def outwards(mesh: Mesh) -> tuple[Mesh, int]:
    """Turn the pieces of a mesh that are inside out.

    A piece is a set of faces connected by edges. It is inside out if the signed volume between its
    surface and its centroid is negative. If the piece has a boundary, the volume must be clearly
    negative: by more than CLEARLY of the volume of a sphere with the area of the piece.

    Args:
        mesh: The surface.

    Returns:
        The mesh with the faces of these pieces reversed, and the number of these pieces.
    """
    count, piece, pairs = _pieces(mesh.vertices, mesh.faces)
    corners = mesh.vertices[mesh.faces]
    sizes = np.bincount(piece, minlength=count)[:, None]
    centres = np.stack(
        [np.bincount(piece, x, minlength=count) for x in corners.mean(axis=1).T], axis=1
    )
    a, b, c = (corners - (centres / sizes)[piece][:, None]).transpose(1, 0, 2)
    volume = np.bincount(piece, (a * np.cross(b, c)).sum(axis=1) / 6, minlength=count)
    area = np.bincount(piece, np.linalg.norm(mesh.face_normals, axis=1) / 2, minlength=count)
    closed = np.bincount(piece[pairs].ravel(), minlength=count) == 3 * sizes[:, 0]
    sphere = area**1.5 / (6 * np.sqrt(np.pi))
    inside_out = volume < np.where(closed, 0.0, -CLEARLY * sphere)
    faces = np.where(inside_out[piece][:, None], mesh.faces[:, ::-1], mesh.faces)
    return mesh.with_faces(faces), int(inside_out.sum())


def _pieces(vertices: np.ndarray, faces: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
    """The pieces that edges connect: their number; the piece of every face, int [F]; and the pairs
    of faces with a common edge, int [P, 2]."""
    pairs = trimesh.Trimesh(vertices, faces, process=False).face_adjacency
    graph = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(faces),) * 2)
    return *connected_components(graph, directed=False), pairs


def _turned(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The faces, turned to agree with their neighbours: in each piece as few as possible."""
    solid = trimesh.Trimesh(vertices, faces, process=False)
    trimesh.repair.fix_winding(solid)  # agrees with an arbitrary face of each piece
    turned = np.asarray(solid.faces, dtype=np.int64)
    changed = (turned != faces).any(axis=1)
    _, piece, _ = _pieces(vertices, turned)
    most = 2 * np.bincount(piece, changed) > np.bincount(piece)
    return np.where(most[piece][:, None], turned[:, ::-1], turned)


def _joined(vertices: np.ndarray, finite: np.ndarray) -> np.ndarray:
    """For every vertex the first one at equal coordinates, int64 [V]; itself if it is not finite.

    Args:
        vertices: float64 [V, 3].
        finite: bool [V], whether the coordinates of each vertex are finite.
    """
    sound = np.flatnonzero(finite)
    _, first, inverse = np.unique(
        vertices[sound] + 0.0, axis=0, return_index=True, return_inverse=True
    )  # + 0.0 makes -0.0 equal to 0.0
    joined = np.arange(len(vertices))
    joined[sound] = sound[first[inverse.reshape(-1)]]
    return joined


def _multiplicity(edges: np.ndarray) -> np.ndarray:
    """How often the edge from every corner of a face to the next occurs.

    Args:
        edges: int [3 F, 2], in the order of `directed_edges`; sorted along axis 1, both directions
            of an edge count as one.

    Returns:
        int64 [F, 3].
    """
    _, number, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    return count[number.reshape(-1)].reshape(-1, 3)


def _cut_open(
    vertices: np.ndarray, faces: np.ndarray, along: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Separate faces along edges, by copies of their vertices.

    Corners of faces at the end of a cut edge remain one vertex where a path over the other edges
    connects them.

    Args:
        vertices: float64 [V, 3].
        faces: int64 [F, 3].
        along: bool [F, 3], whether to cut the edge from each corner to the next.

    Returns:
        The vertices, [W, 3]; the faces, [F, 3]; for each of the W vertices the one that it is a
        copy of, int64 [W]; and the number of edges cut.
    """
    if not along.any():
        return vertices, faces, np.arange(len(vertices)), 0
    edges = directed_edges(faces)
    undirected = np.sort(edges, axis=1)
    cut = along.ravel()
    # edge e of face f has corners 3 f + e and 3 f + (e + 1) % 3
    begin = np.arange(len(edges))
    end = begin - begin % 3 + (begin + 1) % 3
    low = np.where(edges[:, 0] < edges[:, 1], begin, end)  # the corner with the smaller vertex
    high = begin + end - low
    key = undirected[:, 0] * len(vertices) + undirected[:, 1]
    order = np.argsort(key[~cut], kind="stable")
    uncut = np.flatnonzero(~cut)[order]
    same = key[uncut[1:]] == key[uncut[:-1]]
    one, two = uncut[:-1][same], uncut[1:][same]
    # where no edge is cut, all corners stay one vertex, even of faces that meet there alone
    corners = np.flatnonzero(~np.isin(faces.ravel(), undirected[cut]))
    corners = corners[np.argsort(faces.ravel()[corners], kind="stable")]
    again = faces.ravel()[corners[1:]] == faces.ravel()[corners[:-1]]
    rows = np.concatenate([low[one], high[one], corners[:-1][again]])
    columns = np.concatenate([low[two], high[two], corners[1:][again]])
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(len(edges), len(edges)))
    count, number = connected_components(graph, directed=False)
    origin = np.empty(count, dtype=np.int64)
    origin[number] = faces.ravel()
    return (
        vertices[origin],
        number.reshape(-1, 3).astype(np.int64),
        origin,
        len(np.unique(key[cut])),
    )
