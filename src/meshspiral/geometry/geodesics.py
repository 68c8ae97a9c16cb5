"""Geodesic distances on a mesh, by the heat method (Crane et al. 2013) of potpourri3d."""

from __future__ import annotations

import numpy as np
import potpourri3d

from meshspiral.geometry.mesh import Mesh, MeshError, in_use


class GeodesicSolver:
    """Distances from single vertices, in the mesh's unit; the factorisation is made once.

    The heat method is a smooth approximation, within about one per cent at ordinary resolutions.
    From one component to another, and from a vertex without a face, there is no distance: inf.
    Errors: MeshError for a mesh without surface area, or one so degenerate that the method fails.
    """

    def __init__(self, mesh: Mesh):
        if mesh.area == 0:
            raise MeshError(f"{mesh.name}: no surface area, so no distances on it")
        self._used, faces = in_use(mesh.faces)
        self._place = np.full(len(mesh.vertices), -1)
        self._place[self._used] = np.arange(len(self._used))
        self._component = _components(mesh)
        try:
            self._solver = potpourri3d.MeshHeatMethodDistanceSolver(
                mesh.vertices[self._used], faces
            )
        except RuntimeError as error:
            raise MeshError(
                f"{mesh.name}: its faces are so thin that there are no geodesic "
                f"distances to be had ({error})"
            ) from error

    def row(self, source: int) -> np.ndarray:
        """float64 [V], the distance of every vertex to `source`; exactly 0 at the source."""
        row = np.full(len(self._place), np.inf)
        if self._place[source] >= 0:
            distances = self._solver.compute_distance(int(self._place[source]))
            row[self._used] = np.maximum(distances, 0.0)
            row[self._component != self._component[source]] = np.inf
        row[source] = 0.0
        return row


def diameter(mesh: Mesh, sweeps: int = 8) -> float:
    """The largest geodesic distance between two vertices of the largest component.

    Estimated from below: from any vertex to the farthest, from there to the farthest from both,
    and so on (farthest-point sampling), `sweeps` times; the largest distance seen.
    """
    solver = GeodesicSolver(mesh)
    nearest = np.full(len(mesh.vertices), np.inf)
    component = _components(mesh)
    largest, source = 0.0, int(np.argmax(component == np.bincount(component).argmax()))
    for sweep in range(sweeps + 1):
        row = solver.row(source)
        row = np.where(np.isfinite(row), row, 0.0)
        if sweep:  # the first vertex only leads to an end of the shape
            largest = max(largest, float(row.max()))
            nearest = np.minimum(nearest, row)
            source = int(nearest.argmax())
        else:
            source = int(row.argmax())
    return largest


def _components(mesh: Mesh) -> np.ndarray:
    """int [V], a number for the connected component of each vertex."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    start, tip = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2).T
    count = len(mesh.vertices)
    graph = coo_matrix((np.ones(len(start), dtype=bool), (start, tip)), shape=(count, count))
    return connected_components(graph, directed=False)[1]
