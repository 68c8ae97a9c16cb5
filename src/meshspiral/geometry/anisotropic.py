"""Anisotropic heat kernels (Boscaini, Masci, Rodola, Bronstein 2016), the patches of ACNN."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_array

from meshspiral.geometry.laplacian import FLAT, eigenfunctions_of, masses_of
from meshspiral.geometry.mesh import Mesh

ROWS = 1024  # rows of a kernel at a time


class KernelTable(NamedTuple):
    """The largest entries of every vertex's kernels.

    Attributes:
        indices: int32 [V, T, A, K], vertices, the largest entry first, for T times and A angles.
        weights: float32 [V, T, A, K].
    """

    indices: np.ndarray
    weights: np.ndarray


def anisotropic_stiffness(
    mesh: Mesh, directions: np.ndarray, angle: float, anisotropy: float
) -> csc_array:
    """The stiffness matrix of diffusion that is fast in one direction.

    The conductivity of a face is 1 along its first direction and 1 / (1 + anisotropy) along its
    second, both turned by an angle. The matrix holds the integrals of
    grad f_i . conductivity grad f_j for the piecewise linear hat functions f_i.

    Args:
        mesh: The surface.
        directions: float64 [F, 2, 3], orthonormal directions in the plane of each face.
        angle: In radians, counter-clockwise.
        anisotropy: At least 0; with 0 the matrix is that of the cotangent Laplacian.

    Returns:
        [V, V], symmetric and positive semi-definite.
    """
    corners = mesh.vertices[mesh.faces]
    opposite = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)
    doubled = np.linalg.norm(mesh.face_normals, axis=1)
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.stack(
        [
            cos * directions[:, 0] + sin * directions[:, 1],
            cos * directions[:, 1] - sin * directions[:, 0],
        ],
        axis=1,
    )
    edges = np.einsum("fki,fai->fka", opposite, turned)
    # a hat function's gradient is the opposite edge turned by a right angle, over twice the area
    gradients = np.stack([-edges[:, :, 1], edges[:, :, 0]], axis=2)
    conductivity = np.array([1.0, 1.0 / (1.0 + anisotropy)])
    terms = np.einsum("fka,a,fla->fkl", gradients, conductivity, gradients)
    terms /= 2 * (doubled + FLAT * mesh.area)[:, None, None]
    rows = np.repeat(mesh.faces, 3, axis=1).ravel()
    columns = np.tile(mesh.faces, 3).ravel()
    shape = (len(mesh.vertices),) * 2
    return csc_array((terms.ravel(), (rows, columns)), shape=shape)


def anisotropic_kernels(
    mesh: Mesh,
    directions: np.ndarray,
    times: Sequence[float],
    angles: int,
    anisotropy: float,
    entries: int,
    eigenfunctions: int | None = None,
) -> KernelTable:
    """The heat kernels of the anisotropic Laplacians, reduced to their largest entries.

    The kernel of time t is the sum over eigenfunctions f, with eigenvalues v, of
    exp(-v t) f(x) f(y). Its row at x is divided by the square root of its L1 norm, as in the
    authors' published code, and keeps its largest entries; there are no areas in it, and it is
    not normalised again. Masses are those of `laplacian`.

    Args:
        mesh: The surface, in the unit of the times.
        directions: float64 [F, 2, 3], see `anisotropic_stiffness`.
        times: Diffusion times, in the square of the mesh's unit.
        angles: Number of angles, spaced equally in 0..pi.
        anisotropy: See `anisotropic_stiffness`.
        entries: Number of entries K that a row keeps.
        eigenfunctions: Number of eigenfunctions; None for all, which is exact.

    Returns:
        The table. Rows of vertices on no face are 0.

    Raises:
        MeshError: The surface has no area, or ARPACK finds no solution.
    """
    count = len(mesh.vertices)
    entries = min(entries, count)
    shape = (count, len(times), angles, entries)
    table = KernelTable(np.zeros(shape, np.int32), np.zeros(shape, np.float32))
    masses, number = masses_of(mesh), eigenfunctions or count
    isolated = np.bincount(mesh.faces.ravel(), minlength=count) == 0
    for a in range(angles):
        stiffness = anisotropic_stiffness(mesh, directions, a * np.pi / angles, anisotropy)
        values, functions, _ = eigenfunctions_of(mesh, stiffness, masses, number)
        functions = functions.astype(np.float32)
        for t, time in enumerate(times):
            decayed = functions * np.exp(-values * time).astype(np.float32)
            for start in range(0, count, ROWS):
                rows = slice(start, start + ROWS)
                kernel = decayed[rows] @ functions.T
                table.indices[rows, t, a], table.weights[rows, t, a] = _largest(kernel, entries)
    table.weights[isolated] = 0.0
    return table


def _largest(kernel: np.ndarray, entries: int) -> tuple[np.ndarray, np.ndarray]:
    """The largest entries of each row, over the square root of the row's L1 norm.

    Returns:
        Columns, int [R, entries], and values, float32 [R, entries], descending.
    """
    best = np.argpartition(-kernel, entries - 1, axis=1)[:, :entries]
    found = np.take_along_axis(kernel, best, axis=1)
    order = np.argsort(-found, axis=1, kind="stable")
    norms = np.sqrt(np.abs(kernel).sum(axis=1, keepdims=True))
    found = np.take_along_axis(found, order, axis=1) / norms
    return np.take_along_axis(best, order, axis=1), found
