"""Principal curvature directions by normal cycles (Cohen-Steiner, Morvan 2003)."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from meshspiral.geometry.faces import directed_edges
from meshspiral.geometry.mesh import Mesh


def curvature_tensors(mesh: Mesh, smoothing: int) -> np.ndarray:
    """The curvature of the surface around each vertex.

    An edge with unit direction e, length l and signed angle b between the normals of its two faces,
    positive where the surface is convex, adds l b e e^T / 2 to both its vertices. The sum is
    divided by a third of the area of the vertex's faces, and then averaged over the one-ring, the
    vertex included, `smoothing` times. A surface that bends across e has its largest eigenvalue
    along e: the eigenvector of a large eigenvalue is the direction of small curvature.

    Args:
        mesh: The surface.
        smoothing: Number of averagings.

    Returns:
        float64 [V, 3, 3], symmetric, in 1 over the mesh's unit; zeros at isolated vertices.
    """
    ends, angles = dihedral_angles(mesh)
    along = mesh.vertices[ends[:, 1]] - mesh.vertices[ends[:, 0]]
    lengths = np.linalg.norm(along, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        terms = along[:, :, None] * along[:, None, :] * (angles / lengths / 2)[:, None, None]
    terms[lengths == 0] = 0.0
    count = len(mesh.vertices)
    tensors = np.zeros((count, 3, 3))
    for side in range(2):
        np.add.at(tensors, ends[:, side], terms)
    areas = mesh.vertex_areas
    tensors /= np.maximum(areas, 1e-8 * areas.mean() or 1.0)[:, None, None]
    edges = directed_edges(mesh.faces)
    rows, columns = np.concatenate([edges, edges[:, ::-1], np.tile(np.arange(count)[:, None], 2)]).T
    near = csr_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    near.data[:] = 1.0  # edges of two faces came twice
    near = near.multiply(1.0 / near.sum(axis=1)[:, None]).tocsr()
    flat = tensors.reshape(count, 9)
    for _ in range(smoothing):
        flat = near @ flat
    return flat.reshape(count, 3, 3)


def dihedral_angles(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """The edges that have two faces, and the angles between the normals of these.

    Returns:
        Their vertices, int [E, 2], and signed angles, float64 [E], in radians, positive where the
        surface is convex; 0 beside a face of area 0.
    """
    edges = directed_edges(mesh.faces).astype(np.int64)
    count, owner = len(mesh.vertices), np.arange(len(edges)) // 3
    keys = edges.min(axis=1) * count + edges.max(axis=1)
    left, right = (
        np.flatnonzero(edges[:, 0] < edges[:, 1]),
        np.flatnonzero(edges[:, 0] > edges[:, 1]),
    )
    shared, one, two = np.intersect1d(keys[left], keys[right], return_indices=True)
    left, right = owner[left[one]], owner[right[two]]
    ends = np.stack(np.divmod(shared, count), axis=1)
    normals = _unit(mesh.face_normals)
    along = _unit(mesh.vertices[ends[:, 1]] - mesh.vertices[ends[:, 0]])
    a, b = normals[left], normals[right]
    sine = np.einsum("ei,ei->e", np.cross(a, b), along)
    angles = np.arctan2(sine, np.einsum("ei,ei->e", a, b))
    return ends, np.nan_to_num(angles)


def principal_directions(mesh: Mesh, tensors: np.ndarray) -> np.ndarray:
    """The directions of smallest and largest curvature in the plane of each face.

    Args:
        mesh: The surface.
        tensors: float64 [V, 3, 3], see `curvature_tensors`.

    Returns:
        float64 [F, 2, 3], orthonormal, right-handed with the face's normal: smallest, largest.
        Signs are arbitrary, and so is everything where both are equal; zeros on faces of area 0.
    """
    normals = _unit(mesh.face_normals)
    flat = ~np.isfinite(normals).all(axis=1)
    edge = _unit(mesh.vertices[mesh.faces[:, 1]] - mesh.vertices[mesh.faces[:, 0]])
    plane = np.nan_to_num(np.stack([edge, np.cross(normals, edge)], axis=1))
    means = tensors[mesh.faces].mean(axis=1)
    inside = np.einsum("fai,fij,fbj->fab", plane, means, plane)
    _, vectors = np.linalg.eigh(inside)  # ascending: the last is along the small curvature
    small = np.einsum("fa,fai->fi", vectors[:, :, 1], plane)
    small[flat] = 0.0
    return np.stack([small, np.cross(np.nan_to_num(normals), small)], axis=1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """The vectors [K, 3] with length 1; NaN where their length is 0."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
