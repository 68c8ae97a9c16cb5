"""Making a usable mesh of a damaged one, with a record of what was changed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from meshspiral.geometry.mesh import Mesh, MeshError, in_use
from meshspiral.geometry.resample import without_repeats

CLEARLY = 0.05
HOLE = 0.1  # over the square root of the area: the radius of a sphere around what is closed


class Repaired(NamedTuple):
    """A mesh; place int64 [V], for every vertex as it was one of the mesh, or -1; origin int64 [W],
    for every vertex of the mesh the one that it was; and what was changed, in words."""

    mesh: Mesh
    place: np.ndarray
    origin: np.ndarray
    changes: list[str]


def repair(vertices: np.ndarray, faces: np.ndarray, name: str) -> Repaired:
    """A mesh that `Mesh` accepts, of arrays that it may refuse.

    vertices: float [V, 3]. faces: int [F, 3]. In this order: faces go that name a vertex that is
    not there or not finite, or one vertex twice, and faces that repeat another; vertices at one
    place become one, faces without area by that go too; the surface is cut open along edges with
    more than two faces; holes no larger than HOLE are closed, without new vertices; faces are
    turned to agree with their neighbours, and along edges where they can't the surface is cut open
    as well. Errors: MeshError if no face is left.
    """
    vertices, faces = np.array(vertices, dtype=np.float64), np.array(faces, dtype=np.int64)
    for array, what in ((vertices, "vertices"), (faces, "faces")):
        if array.ndim != 2 or array.shape[1] != 3:
            raise MeshError(f"{name}: {what} must have three columns, got {array.shape}")
    changes: list[str] = []

    def note(count: int, what: str) -> None:
        if count:
            changes.append(f"{count:,} {what}")

    finite = np.isfinite(vertices).all(axis=1)
    inside = ((faces >= 0) & (faces < len(vertices))).all(axis=1)
    faces = faces[inside]
    sound = finite[faces].all(axis=1)
    note(int((~finite).sum()), "vertices with coordinates that are not finite left out")
    note(int((~inside).sum()), "faces naming vertices that are not there left out")
    note(int((~sound).sum()), "faces at vertices that are not finite left out")
    faces, place = faces[sound], np.where(finite, np.arange(len(vertices)), -1)
    before = len(faces)
    faces = without_repeats(faces)
    note(before - len(faces), "faces left out that named a vertex twice or repeated another")

    kept = np.flatnonzero(finite)
    _, first, inverse = np.unique(
        vertices[kept] + 0.0, axis=0, return_index=True, return_inverse=True
    )
    one = np.arange(len(vertices))
    one[kept] = kept[first[inverse.reshape(-1)]]
    note(int((one != np.arange(len(vertices))).sum()), "vertices joined with others at their place")
    place[kept] = one[kept]
    before = len(faces)
    faces = without_repeats(one[faces])
    note(before - len(faces), "faces left out that then were nothing or repeated another")
    if not len(faces):
        raise MeshError(f"{name}: no face that can be used")

    vertices[~finite] = 0.0
    vertices, faces, origin, cuts = cut_open(vertices, faces, crowded(faces))
    note(cuts, "edges with more than two faces cut open")
    before = len(faces)
    faces = closed(vertices, faces)
    note(len(faces) - before, "faces put into holes")
    wound = trimesh.Trimesh(vertices, faces, process=False)
    trimesh.repair.fix_winding(wound)
    turned = np.asarray(wound.faces, dtype=np.int64)
    note(int((turned != faces).any(axis=1).sum()), "faces turned to agree with their neighbours")
    vertices, faces, again, cuts = cut_open(vertices, turned, against(turned))
    note(cuts, "edges cut open where the faces can't agree")
    origin = origin[again]

    used, faces = in_use(faces)
    became = np.full(len(place) + 1, -1)
    became[origin[used][::-1]] = np.arange(len(used))[::-1]  # of the copies of a vertex the first
    mesh = Mesh(vertices[used], faces, name)
    return Repaired(mesh, became[place], origin[used], changes)


def outwards(mesh: Mesh) -> tuple[Mesh, int]:
    """The mesh with those of its pieces turned that are inside out, and how many these are.

    A piece is what edges hold together. It is inside out if the volume that it encloses with its
    own centre is negative; where the piece has a boundary, clearly so: by more than CLEARLY of the
    volume of a sphere with its area.
    """
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    pairs = solid.face_adjacency
    graph = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(mesh.faces),) * 2)
    count, piece = connected_components(graph, directed=False)
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
    return Mesh(mesh.vertices, faces, mesh.name), int(inside_out.sum())


def closed(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The faces, and behind them others that close the small holes."""
    import pyvista  # takes a second

    corners = vertices[faces]
    with np.errstate(over="ignore", invalid="ignore"):
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(normals, axis=1).sum() / 2
    if not 0 < area < np.inf:
        return faces
    surface = pyvista.make_tri_mesh(vertices, faces).fill_holes(HOLE * np.sqrt(area))
    filled = surface.triangulate().regular_faces.astype(np.int64)
    filled[len(faces) :] = filled[len(faces) :, ::-1]  # VTK winds them along the boundary
    filled = without_repeats(filled)
    third = crowded(filled).any(axis=1)
    third[: len(faces)] = False
    return filled[~third]


def crowded(faces: np.ndarray) -> np.ndarray:
    """bool [F, 3]: whether the edge from corner k to the next has more than two faces."""
    _, number, count = np.unique(
        np.sort(edges(faces), axis=1), axis=0, return_inverse=True, return_counts=True
    )
    return (count > 2)[number.reshape(-1)].reshape(-1, 3)


def against(faces: np.ndarray) -> np.ndarray:
    """bool [F, 3]: whether the edge from corner k to the next has two faces in that direction."""
    _, number, count = np.unique(edges(faces), axis=0, return_inverse=True, return_counts=True)
    return (count > 1)[number.reshape(-1)].reshape(-1, 3)


def edges(faces: np.ndarray) -> np.ndarray:
    """[3 F, 2]: those of each face, in its direction."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def cut_open(
    vertices: np.ndarray, faces: np.ndarray, along: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Separates the faces at some of their edges: vertices [W, 3], faces [F, 3], for each of the W
    vertices the one it is a copy of, and the number of edges.

    along: bool [F, 3], edges from corner k to the next. Corners of faces stay one vertex where a
    path over the other edges joins them.
    """
    if not along.any():
        return vertices, faces, np.arange(len(vertices)), 0
    pairs = edges(faces)
    undirected = np.sort(pairs, axis=1)
    flat = along.ravel()
    # edge e of face f has corners 3 f + e and 3 f + (e + 1) % 3
    begin = np.arange(len(pairs))
    end = begin - begin % 3 + (begin + 1) % 3
    low = np.where(pairs[:, 0] < pairs[:, 1], begin, end)
    high = begin + end - low
    key = undirected[:, 0] * len(vertices) + undirected[:, 1]
    order = np.argsort(key[~flat], kind="stable")
    open_ = np.flatnonzero(~flat)[order]
    same = key[open_[1:]] == key[open_[:-1]]
    one, two = open_[:-1][same], open_[1:][same]
    rows, columns = np.concatenate([low[one], high[one]]), np.concatenate([low[two], high[two]])
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(len(pairs), len(pairs)))
    count, number = connected_components(graph, directed=False)
    origin = np.empty(count, dtype=np.int64)
    origin[number] = faces.ravel()
    return (
        vertices[origin],
        number.reshape(-1, 3).astype(np.int64),
        origin,
        len(np.unique(key[flat])),
    )
