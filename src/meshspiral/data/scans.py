"""Meshes as they come: read, judged, and mended where that is asked for."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh

from meshspiral.geometry.mesh import Mesh, MeshError, in_use, read_arrays
from meshspiral.geometry.repair import outwards
from meshspiral.geometry.repair import repair as mend

LEAST, MOST = 1e-70, 1e70  # of a size, in whatever unit: beyond, squares of areas are no numbers


class Scan(NamedTuple):
    """vertices [V, 3] and faces [F, 3] as the user has them; a mesh of W vertices that can be
    worked with, each on a face; place int64 [V], for every vertex of the user one of that mesh, or
    -1 if it is on no face; origin int64 [W], for every vertex of the mesh the user's; and what
    there is to say of it."""

    vertices: np.ndarray
    faces: np.ndarray
    mesh: Mesh
    place: np.ndarray
    origin: np.ndarray
    remarks: list[str]


def open_scan(path: str | Path, repair: bool = False) -> Scan:
    """A mesh file, see `scan`. Errors: MeshError, also where `read_mesh` raises it."""
    return scan(*read_arrays(path), str(path), repair)


def scan(vertices: np.ndarray, faces: np.ndarray, name: str, repair: bool = False) -> Scan:
    """A mesh given as arrays [V, 3] and [F, 3].

    repair: mend what `Mesh` refuses, see `meshspiral.geometry.repair`. A surface that is inside out is
    turned in any case. Errors: MeshError, which says whether repair=True would help.
    """
    remarks = []
    if repair:
        mesh, place, origin, changes = mend(vertices, faces, name)
        remarks += [f"mended: {change}" for change in changes]
    else:
        try:
            mesh = Mesh(vertices, faces, name)
        except MeshError as error:
            raise MeshError(f"{error}; repair=true mends that") from error
        place = origin = np.arange(len(mesh.vertices))
        joined = len(mesh.vertices) - len(np.unique(mesh.vertices + 0.0, axis=0))
        if joined:
            remarks.append(
                f"{joined:,} vertices are at the place of another: if the surface is "
                "torn there, repair=true joins them"
            )
    if not len(mesh.faces):
        raise MeshError(f"{name}: no faces, so there is no surface to match")
    size = np.ptp(mesh.vertices[mesh.faces].reshape(-1, 3), axis=0).max()
    if not LEAST < size < MOST or not 0 < mesh.area < np.inf:
        raise MeshError(
            f"{name}: {size:.3g} across, which is no surface to describe; it needs an "
            f"area, and a size of {LEAST:g} to {MOST:g}"
        )
    used, numbered = in_use(mesh.faces)
    number = np.full(len(mesh.vertices) + 1, -1)
    number[used] = np.arange(len(used))
    place, origin = number[place], origin[used]
    mesh, turned = outwards(Mesh(mesh.vertices[used], numbered, name))
    if turned:
        remarks.append(f"{turned:,} pieces of the surface were inside out and have been turned")
    if lost := int((place < 0).sum()):
        remarks.append(f"{lost:,} of {len(place):,} vertices are on no face and get no match")
    flat = int((np.linalg.norm(mesh.face_normals, axis=1) == 0).sum())
    if flat:
        remarks.append(f"{flat:,} faces without area")
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    if solid.body_count > 1:
        remarks.append(f"{solid.body_count} components; descriptors reach across their gaps")
    if not solid.is_watertight:
        remarks.append("the surface has a boundary; near it matches are less certain")
    return Scan(np.asarray(vertices), np.asarray(faces), mesh, place, origin, remarks)
