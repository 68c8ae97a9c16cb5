"""The Laplacian of a surface: its eigenvalues and eigenfunctions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import potpourri3d
from scipy.linalg import eigh
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import ArpackError, eigsh

from meshspiral.geometry.mesh import Mesh, MeshError, used_vertices

ROUNDS = 100  # iterations of ARPACK; a mesh needs a few, one far from a surface would take minutes
FLAT = 1e-10  # of the surface's area, is added to twice the area of a face, which may be 0
SMALL = 400  # vertices up to which all eigenfunctions are computed at once, which is faster there


class Spectrum(NamedTuple):
    """The smallest eigenvalues of a surface's Laplacian, and their eigenfunctions.

    Attributes:
        values: float64 [K], ascending, at least 0, in 1 over the square of the mesh's unit.
        functions: float64 [V, K], orthonormal with respect to the masses, and 0 at vertices on no
            face. Signs, and bases of repeated eigenvalues, are arbitrary.
        masses: float64 [V], in the square of the mesh's unit.
    """

    values: np.ndarray
    functions: np.ndarray
    masses: np.ndarray


def laplacian(mesh: Mesh) -> tuple[csc_array, np.ndarray]:
    """The stiffness matrix with cotangent weights, and the masses of the vertices.

    Args:
        mesh: The surface.

    Returns:
        The stiffness matrix, [V, V], positive semi-definite, as potpourri3d computes it; and
        `masses_of` the mesh.

    Raises:
        MeshError: The surface has no area.
    """
    masses = masses_of(mesh)
    # it does not depend on the unit of length, but denom_eps does
    unit = mesh.vertices / np.sqrt(mesh.area)
    stiffness = potpourri3d.cotan_laplacian(unit, mesh.faces, denom_eps=FLAT)
    return csc_array(stiffness), masses


def masses_of(mesh: Mesh) -> np.ndarray:
    """A third of the area of the faces of each vertex, and at least 1e-8 of the mean.

    Args:
        mesh: The surface, V vertices.

    Returns:
        float64 [V], in the square of the mesh's unit.

    Raises:
        MeshError: The surface has no area.
    """
    if mesh.area == 0:
        raise MeshError(f"{mesh.name}: surface area must be above 0 for a Laplacian, got 0")
    return np.maximum(mesh.vertex_areas, 1e-8 * mesh.vertex_areas.mean())


def spectrum(mesh: Mesh, count: int) -> Spectrum:
    """The eigenfunctions of the Laplacian with the smallest eigenvalues.

    Args:
        mesh: The surface.
        count: Number of eigenfunctions K; at most that of the vertices on a face.

    Returns:
        K eigenvalues, ascending; functions, with columns orthonormal under the masses; and masses.

    Raises:
        MeshError: The surface has no area, or ARPACK finds no solution.
    """
    stiffness, masses = laplacian(mesh)
    return eigenfunctions_of(mesh, stiffness, masses, count)


def eigenfunctions_of(mesh: Mesh, stiffness: csc_array, masses: np.ndarray, count: int) -> Spectrum:
    """The solutions of stiffness f = value * masses f with the smallest values.

    Args:
        mesh: The surface, for its area and for messages.
        stiffness: [V, V], positive semi-definite.
        masses: float64 [V], above 0.
        count: Number of solutions K; at most that of the vertices on a face.

    Raises:
        MeshError: ARPACK finds no solution.
    """
    used, faces = used_vertices(mesh.faces)
    if len(used) < len(masses):  # a vertex alone would have an eigenvalue of 0 of its own
        part = Mesh(mesh.vertices[used], faces, mesh.name)
        inner = eigenfunctions_of(part, stiffness[used][:, used], masses[used], count)
        functions = np.zeros((len(masses), inner.functions.shape[1]))
        functions[used] = inner.functions
        return Spectrum(inner.values, functions, masses)
    if len(masses) <= max(SMALL, count + 1):
        roots = np.sqrt(masses)
        matrix = stiffness.toarray() / np.outer(roots, roots)
        values, functions = eigh(matrix, driver="evd", check_finite=False)
        values, functions = values[:count], (functions / roots[:, None])[:, :count]
        return Spectrum(np.maximum(values, 0.0), functions, masses)
    shift = -1e-8 * 4 * np.pi**2 / mesh.area  # just below 0, the least eigenvalue
    try:
        values, functions = eigsh(
            stiffness,
            k=count,
            M=diags_array(masses, format="csc"),
            sigma=shift,
            v0=np.ones(len(masses)),
            maxiter=ROUNDS,
        )
    except (ArpackError, RuntimeError) as error:
        raise MeshError(
            f"{mesh.name}: no eigenfunctions of the Laplacian found ({error})"
        ) from error
    order = np.argsort(values)
    return Spectrum(np.maximum(values[order], 0.0), functions[:, order], masses)
