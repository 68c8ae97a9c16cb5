"""ZoomOut: spectral refinement of a map between two surfaces.

Melzi, Ren, Rodola, Sharma, Wonka, Ovsjanikov, "ZoomOut: Spectral upsampling for efficient shape
correspondence" (2019).
"""

from __future__ import annotations

import numpy as np

from meshspiral.geometry.kdtree import kd_tree
from meshspiral.geometry.laplacian import spectrum
from meshspiral.geometry.mesh import Mesh, MeshError

FROM, TO, STEP = 20, 80, 5  # numbers of eigenfunctions: first, last, increment


def eigenfunctions(mesh: Mesh, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The eigenfunctions of the Laplacian with the smallest eigenvalues, and the masses.

    Args:
        mesh: The surface.
        count: Number of eigenfunctions.

    Returns:
        `functions`, float64 [V, count], and `masses`, float64 [V], of `spectrum`.

    Raises:
        MeshError: The mesh has no more than `count` vertices, or ARPACK finds no solution.
    """
    if count >= len(mesh.vertices):
        raise MeshError(
            f"{mesh.name}: {count} eigenfunctions need more than {count} vertices, "
            f"got {len(mesh.vertices)}"
        )
    _, functions, masses = spectrum(mesh, count)
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
        _, match = kd_tree(others[:, :count] @ functional_map.T).query(basis)
    return match
