"""Meshes of any origin: read, checked, repaired on request, and described by remarks."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh

from meshspiral.data.mesh_files import read_arrays
from meshspiral.geometry.holes import close_holes
from meshspiral.geometry.mesh import Mesh, MeshError, used_vertices
from meshspiral.geometry.repair import outwards
from meshspiral.geometry.repair import repair as repair_arrays

SMALLEST, LARGEST = 1e-70, 1e70  # extents in any unit; beyond, squares of areas leave float64


class Scan(NamedTuple):
    """A user's mesh, and the part of it that can be labelled.

    Attributes:
        vertices: float [V, 3], as given.
        faces: int [F, 3], as given.
        mesh: W vertices, each on a face, oriented outwards; small holes are closed.
        vertex_of: int64 [V], the vertex of `mesh` for every given vertex; -1 if it is on no face.
        origin: int64 [W], the given vertex for every vertex of `mesh`.
        remarks: Repairs and defects of the mesh, for the user.
        repaired: Whether anything was repaired.
    """

    vertices: np.ndarray
    faces: np.ndarray
    mesh: Mesh
    vertex_of: np.ndarray
    origin: np.ndarray
    remarks: list[str]
    repaired: bool = False


def open_scan(path: str | Path, repair: bool = False) -> Scan:
    """Read a mesh file: PLY, OBJ, OFF, STL or GLB.

    Args:
        path: The file.
        repair: See `scan`.

    Raises:
        MeshError: The file cannot be read, or its mesh cannot be used.
    """
    return scan(*read_arrays(path), str(path), repair)


def scan(vertices: np.ndarray, faces: np.ndarray, name: str, repair: bool = False) -> Scan:
    """Check a mesh given as arrays. Components that are inside out are turned.

    Args:
        vertices: float [V, 3].
        faces: int [F, 3].
        name: Used in messages.
        repair: Repair what `Mesh` refuses, see `meshspiral.geometry.repair`.

    Raises:
        MeshError: The mesh cannot be used. The message says whether `repair` fixes it.
    """
    remarks = []
    if repair:
        mesh, vertex_of, origin, changes = repair_arrays(vertices, faces, name)
        remarks += [f"repaired: {change}" for change in changes]
    else:
        changes = []
        try:
            mesh = Mesh(vertices, faces, name)
        except MeshError as error:
            raise MeshError(f"{error}; repair=true fixes this") from error
        vertex_of = origin = np.arange(len(mesh.vertices))
        duplicates = len(mesh.vertices) - len(np.unique(mesh.vertices + 0.0, axis=0))  # -0 is 0
        if duplicates:
            remarks.append(
                f"vertices at the position of another: {duplicates:,}; if the surface is torn "
                "there, repair=true joins them"
            )
    if not len(mesh.faces):
        raise MeshError(f"{name}: a surface must have at least 1 face, got 0")
    extent = np.ptp(mesh.vertices[mesh.faces].reshape(-1, 3), axis=0).max()
    if not SMALLEST < extent < LARGEST:
        raise MeshError(f"{name}: the extent must be {SMALLEST:g} to {LARGEST:g}, got {extent:.3g}")
    if not 0 < mesh.area < np.inf:
        raise MeshError(f"{name}: the surface area must be above 0, got {mesh.area:.3g}")
    used, faces_of_used = used_vertices(mesh.faces)
    new_index = np.full(len(mesh.vertices) + 1, -1)  # the last entry is that of vertex -1
    new_index[used] = np.arange(len(used))
    vertex_of, origin = new_index[vertex_of], origin[used]
    mesh, turned = outwards(Mesh(mesh.vertices[used], faces_of_used, name))
    if turned:
        remarks.append(f"inside-out components turned outwards: {turned:,}")
    closed = close_holes(mesh)
    if added := len(closed.faces) - len(mesh.faces):
        remarks.append(f"small holes closed for the labels, with faces: {added:,}")
    mesh = closed
    if isolated := int((vertex_of < 0).sum()):
        remarks.append(f"vertices on no face, without a match: {isolated:,} of {len(vertex_of):,}")
    if flat := int((np.linalg.norm(mesh.face_normals, axis=1) == 0).sum()):
        remarks.append(f"faces of zero area: {flat:,}")
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    if solid.body_count > 1:
        remarks.append(f"components: {solid.body_count}; descriptors reach across the gaps")
    if not solid.is_watertight:
        remarks.append("the surface has a boundary; matches near it are less certain")
    return Scan(
        np.asarray(vertices),
        np.asarray(faces),
        mesh,
        vertex_of,
        origin,
        remarks,
        repaired=bool(changes),
    )
