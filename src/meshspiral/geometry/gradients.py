"""Gradients of functions on a surface, in the tangent plane of each vertex."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from meshspiral.geometry.connectivity import one_rings
from meshspiral.geometry.mesh import Mesh

FLAT = 1e-6  # one-rings whose width is a smaller share of their length count as lines


class Gradients(NamedTuple):
    """Gradients as weighted sums of values.

    The gradient of f at vertex v is the sum over k in first[v]:first[v+1] of
    weights[k] * f[indices[k]], in the plane spanned by axes[v].

    Attributes:
        indices: int32 [E], vertices: v itself, then its one-ring.
        weights: float64 [E, 2], in 1 over the mesh's unit.
        first: int32 [V + 1].
        axes: float64 [V, 2, 3], two orthonormal directions; with the normal they are right-handed.
    """

    indices: np.ndarray
    weights: np.ndarray
    first: np.ndarray
    axes: np.ndarray


def vertex_gradients(mesh: Mesh) -> Gradients:
    """The gradients of linear functions that fit the one-ring best (Sharp et al. 2022, 3.3).

    At vertex v with normal n, the edges to its neighbours are projected into the plane orthogonal
    to n. The gradient g minimises the sum over neighbours u of
    (f(u) - f(v) - g . edge(u))^2. On a plane it is exact for linear functions. Where the
    projected edges lie on a line, g is the shortest minimiser; at a vertex without a normal it
    is 0.

    Args:
        mesh: The surface.

    Returns:
        The gradients of all vertices. Turning `axes[v]` in their plane turns the gradient alike.
    """
    neighbours, first = one_rings(mesh)
    degree = np.diff(first)
    centres = np.repeat(np.arange(len(degree)), degree)
    axes = tangent_axes(mesh.vertex_normals)
    edges = mesh.vertices[neighbours] - mesh.vertices[centres]
    flat = np.einsum("eij,ej->ei", axes[centres], edges)
    squares = np.zeros((len(degree), 2, 2))
    np.add.at(squares, centres, flat[:, :, None] * flat[:, None, :])
    inverses = np.linalg.pinv(squares, rcond=FLAT**2, hermitian=True)
    around = np.einsum("eij,ej->ei", inverses[centres], flat)
    own = np.zeros((len(degree), 2))
    np.add.at(own, centres, -around)
    return Gradients(
        np.insert(neighbours, first[:-1], np.arange(len(degree))).astype(np.int32),
        np.insert(around, first[:-1], own, axis=0),
        (first + np.arange(len(first))).astype(np.int32),
        axes,
    )


def tangent_axes(normals: np.ndarray) -> np.ndarray:
    """Two orthonormal directions in the plane orthogonal to each normal.

    Args:
        normals: float64 [V, 3], unit vectors, or NaN.

    Returns:
        float64 [V, 2, 3]; zeros where the normal is NaN.
    """
    other = np.zeros_like(normals)
    rows = np.arange(len(normals))
    other[rows, np.argmin(np.abs(np.nan_to_num(normals)), axis=1)] = 1.0
    first = np.cross(normals, other)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.nan_to_num(np.stack([first, np.cross(normals, first)], axis=1))
