"""ZoomOut: spectral refinement of a map between two surfaces.

Melzi, Ren, Rodola, Sharma, Wonka, Ovsjanikov, "ZoomOut: Spectral upsampling for efficient shape
correspondence" (2019).
"""

from __future__ import annotations

import numpy as np
import potpourri3d
from scipy.sparse import diags_array
from scipy.sparse.linalg import ArpackError, eigsh
from scipy.spatial import cKDTree

from meshspiral.geometry.mesh import Mesh, MeshError

FROM, TO, STEP = 20, 80, 5  # numbers of eigenfunctions: first, last, increment
ROUNDS = 100  # iterations of ARPACK; a mesh needs a few, one far from a surface would take minutes


def eigenfunctions(mesh: Mesh, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The eigenfunctions of the Laplacian with the smallest eigenvalues.

    The stiffness matrix has cotangent weights, as potpourri3d computes them. The mass of a vertex
    is a third of the area of its faces, and at least 1e-8 of the mean mass.

    Args:
        mesh: The surface.
        count: Number of eigenfunctions.

    Returns:
        The eigenfunctions, float64 [V, count], orthonormal with respect to the masses; and the
        masses, float64 [V], in the square of the mesh's unit.

    Raises:
        MeshError: The mesh has no more than `count` vertices, or ARPACK finds no solution.
    """
    if count >= len(mesh.vertices):
        raise MeshError(
            f"{mesh.name}: {count} eigenfunctions need more than {count} vertices, "
            f"got {len(mesh.vertices)}"
        )
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
        raise MeshError(
            f"{mesh.name}: no eigenfunctions of the Laplacian found ({error})"
        ) from error
    return functions, masses


def zoomout(
    functions: np.ndarray, masses: np.ndarray, others: np.ndarray, match: np.ndarray
) -> np.ndarray:
    """Refine a map from one surface to another.

    Both surfaces should be complete and of equal area.

    Args:
        functions: float64 [V, TO], eigenfunctions of the surface that is mapped.
        masses: float64 [V], its masses.
        others: float64 [W, TO], eigenfunctions of the surface that is mapped to.
        match: int64 [V], the initial map: a vertex of the other surface for every vertex.

    Returns:
        int64 [V], the refined map.
    """
    for count in range(FROM, TO + 1, STEP):
        basis = functions[:, :count]
        functional_map = (basis.T * masses) @ others[match, :count]
        _, match = cKDTree(others[:, :count] @ functional_map.T).query(basis)
    return match
