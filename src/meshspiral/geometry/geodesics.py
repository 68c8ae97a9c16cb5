"""Geodesic distances on a mesh, by the heat method of potpourri3d."""

from __future__ import annotations

import numpy as np
import potpourri3d
from trimesh.graph import connected_component_labels

from meshspiral.geometry.mesh import Mesh, MeshError, used_vertices


class GeodesicSolver:
    """Geodesic distances from single vertices by the heat method (Crane et al. 2013).

    The matrices are factorised once. The heat method is a smooth approximation, within about 1 % at
    ordinary resolutions.

    Args:
        mesh: The surface. Isolated vertices are allowed.

    Attributes:
        component: int32 [V], the connected component of every vertex, numbered from 0.

    Raises:
        MeshError: The mesh has no surface area, or its faces are too degenerate for the method.
    """

    def __init__(self, mesh: Mesh):
        if mesh.area == 0:
            raise MeshError(f"{mesh.name}: no surface area, so there are no geodesic distances")
        self._used, faces = used_vertices(mesh.faces)
        self._solver_index = np.full(len(mesh.vertices), -1)  # of every vertex; -1 on no face
        self._solver_index[self._used] = np.arange(len(self._used))
        self.component = _components(mesh)
        try:
            self._solver = potpourri3d.MeshHeatMethodDistanceSolver(
                mesh.vertices[self._used], faces
            )
        except RuntimeError as error:
            raise MeshError(
                f"{mesh.name}: faces too degenerate for geodesic distances ({error})"
            ) from error

    def row(self, source: int) -> np.ndarray:
        """The distances of all vertices to one.

        Args:
            source: Index of a vertex.

        Returns:
            float64 [V], in the mesh's unit; exactly 0 at the source, inf on other components and
            everywhere else if the source is on no face.
        """
        row = np.full(len(self._solver_index), np.inf)
        if self._solver_index[source] >= 0:
            distances = self._solver.compute_distance(int(self._solver_index[source]))
            row[self._used] = np.maximum(distances, 0.0)
            row[self.component != self.component[source]] = np.inf
        row[source] = 0.0
        return row


def diameter(mesh: Mesh, sweeps: int = 8) -> float:
    """The geodesic diameter of the largest component, estimated from below.

    Farthest-point sampling: from any vertex to the farthest one, from there to the one farthest
    from both, and so on. The estimate is the largest distance found.

    Args:
        mesh: The surface.
        sweeps: Number of samples whose distances count.

    Returns:
        The estimate, in the mesh's unit.

    Raises:
        MeshError: As `GeodesicSolver`.
    """
    solver = GeodesicSolver(mesh)
    nearest = np.full(len(mesh.vertices), np.inf)  # distance to the nearest sample
    in_largest = solver.component == np.bincount(solver.component).argmax()
    largest, source = 0.0, int(np.argmax(in_largest))
    for sweep in range(sweeps + 1):
        row = solver.row(source)
        row = np.where(np.isfinite(row), row, 0.0)
        if sweep:  # the first vertex is arbitrary and only leads to an extremity
            largest = max(largest, float(row.max()))
            nearest = np.minimum(nearest, row)
            source = int(nearest.argmax())
        else:
            source = int(row.argmax())
    return largest


def _components(mesh: Mesh) -> np.ndarray:
    """The connected component of every vertex, int32 [V]."""
    edges = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)  # two edges connect a face's corners
    return connected_component_labels(edges, node_count=len(mesh.vertices))
