"""Refinement of a map between surfaces by ZoomOut (Melzi, Ren, Rodola, Sharma, Wonka, Ovsjanikov
2019)."""

from __future__ import annotations

import numpy as np
from scipy.sparse import diags_array
from scipy.sparse.linalg import ArpackError, eigsh
from scipy.spatial import cKDTree

from meshspiral.geometry.mesh import Mesh, MeshError

FROM, TO, STEP = 20, 80, 5  # numbers of eigenfunctions
ROUNDS = 100  # of ARPACK: a mesh needs a few, one far from a surface would take minutes


def eigenfunctions(mesh: Mesh, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The first of the Laplacian's, float64 [V, count], orthonormal in the masses; and the masses
    float64 [V], a third of the area around each vertex.

    Cotangent weights, as potpourri3d computes them; a vertex without area gets the least mass there
    is. Errors: MeshError where there are fewer vertices than asked for, or no solution.
    """
    import potpourri3d

    if count >= len(mesh.vertices):
        raise MeshError(f"{mesh.name}: {count} eigenfunctions of {len(mesh.vertices)} vertices")
    stiffness = potpourri3d.cotan_laplacian(mesh.vertices, mesh.faces, denom_eps=1e-10)
    masses = potpourri3d.vertex_areas(mesh.vertices, mesh.faces)
    masses = np.maximum(masses, 1e-8 * masses.mean())
    shift = -1e-8 * 4 * np.pi**2 / mesh.area  # just below 0, the least eigenvalue
    try:
        _, functions = eigsh(
            stiffness,
            k=count,
            M=diags_array(masses, format="csc"),
            sigma=shift,
            v0=np.ones(len(masses)),
            maxiter=ROUNDS,
        )
    except (ArpackError, RuntimeError) as error:
        raise MeshError(f"{mesh.name}: its Laplacian has no eigenfunctions ({error})") from error
    return functions, masses


def zoomout(
    functions: np.ndarray, masses: np.ndarray, others: np.ndarray, match: np.ndarray
) -> np.ndarray:
    """int64 [V]: the map with its noise gone. Both surfaces should be whole, and of one area.

    functions, masses: of the surface that the map is from. others: float64 [K, TO], the functions
    of the one that it leads to. match: int64 [V], for every vertex one of the other surface.
    """
    for count in range(FROM, TO + 1, STEP):
        here = functions[:, :count]
        coefficients = (here.T * masses) @ others[match, :count]
        _, match = cKDTree(others[:, :count] @ coefficients.T).query(here)
    return match
