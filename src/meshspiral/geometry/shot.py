"""SHOT (signatures of histograms of orientations): a local descriptor of a surface at its vertices.

Salti, Tombari, Di Stefano, "SHOT: Unique signatures of histograms for surface and texture
description", Computer Vision and Image Understanding 125 (2014). The paper leaves many details
open. This module computes what the Point Cloud Library (PCL) 1.13 computes, to within 1e-5.

Descriptors published for FAUST were made with a variant that depends on the unit of length (weights
R - d^2 in the local frame, an azimuth modulus of 28). They cannot be reproduced exactly; the
variant is not implemented here.

Votes jump where a neighbour crosses the border of a histogram cell, and axes flip where the votes
on their signs tie. Rounding alone therefore changes some rows, less than 1 %, of a rotated mesh.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from meshspiral.geometry.angles import arccos, eighth

SECTORS = 32  # 8 in azimuth x 2 in radius x 2 in elevation
LEAST_NEIGHBOURS = 5  # with fewer, not counting points at the centre, there is no local frame
MOST_CELLS = 2**21 - 3  # along an axis of the search grid: three indices fit into an int64


def shot_descriptors(
    vertices: np.ndarray,
    normals: np.ndarray,
    radius: float,
    bins: int = 16,
    pcl_cosine_wrap: bool = False,
    masses: np.ndarray | None = None,
) -> np.ndarray:
    """The SHOT descriptor of every vertex (Salti, Tombari, Di Stefano 2014).

    Column: (4 * azimuth + 2 * outer + upper) * (bins + 1) + bin.

    Renumbering the vertices permutes the rows. Sums, and ties of distance, follow the order of the
    coordinates, where PCL follows the numbers of the vertices. Two exceptions remain: sums over
    points at equal coordinates follow the numbers, within float64 rounding; and a mesh with exact
    ties, such as an undeformed icosphere, has rows that depend on its orientation.

    Args:
        vertices: float [V, 3], in any unit of length. They are rounded to float32, as in PCL, so
            the distance of a mesh from the origin should be at most a few times its size. A vertex
            with coordinates that are not finite is nobody's neighbour.
        normals: float [V, 3], of unit length. A vertex whose normal is not finite counts in the
            local frames but casts no votes. A normal of zero length votes like one perpendicular to
            the z axis.
        radius: Of the support and of the local frame, in the unit of the vertices; usually
            0.06 * sqrt(surface area).
        bins: Steps of the cosine between a neighbour's normal and the z axis. 16 gives 544
            dimensions, 10 gives 352.
        pcl_cosine_wrap: Repeat an error of PCL, to compare with its values: cosine votes of bin
            `bins - 1` towards bin `bins` go to bin 0. The authors' own code has corrected it.
        masses: float [V], the weight of each vertex in frames and histograms, for instance its
            area; None for 1, as in SHOT. With areas, the descriptor depends less on the density of
            the vertices.

    Returns:
        float32 [V, 32 * (bins + 1)], rows of unit L2 norm. A row is NaN where the descriptor is
        undefined: the vertex's coordinates are not finite; fewer than five vertices are nearer than
        the radius and at other coordinates than the vertex; or none of these has a finite normal.

    Raises:
        ValueError: An array has another shape; `bins` is not an integer or below 1; or `radius`, or
            its square in float32, is not positive and finite.
    """
    vertices, normals = np.asarray(vertices), np.asarray(normals)
    check_support(vertices, radius)
    if normals.shape != vertices.shape:
        raise ValueError(
            f"normals must be {vertices.shape}, like the vertices, got {normals.shape}"
        )
    if not isinstance(bins, (int, np.integer)) or bins < 1:
        raise ValueError(f"bins must be an integer of at least 1, got {bins}")
    return _descriptors_and_frames(vertices, normals, radius, bins, pcl_cosine_wrap, masses)[0]


class Frame(NamedTuple):
    """What defines the local frames of a mesh.

    Attributes:
        support: Radius of the support over the square root of the surface area.
        by_area: Whether vertices weigh by their areas instead of equally.
    """

    support: float
    by_area: bool


def check_support(vertices: np.ndarray, radius: float) -> None:
    """Check the points and the radius of a support.

    Raises:
        ValueError: The vertices are not [V, 3]; or `radius`, or its square in float32, is not
            positive and finite.
    """
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"vertices must be [V, 3], got {vertices.shape}")
    with np.errstate(over="ignore", under="ignore"):
        square = np.float32(float(radius) * float(radius))
    if not (radius > 0 and 0 < square < np.inf):
        raise ValueError(
            f"radius must be positive and finite, and so must its float32 square, got {radius}"
        )


def local_frames(
    vertices: np.ndarray, radius: float, masses: np.ndarray | None = None
) -> np.ndarray:
    """The local frame of every vertex (Salti, Tombari, Di Stefano 2014, section 3).

    The axes are those of the covariance of the vertices nearer than the radius, weighted by
    (radius - distance) times their mass. The x axis has the largest variance and points to the side
    with most mass; so does the z axis, which has the smallest; y is z x x.

    Args:
        vertices: float [V, 3]; as for `shot_descriptors`.
        radius: Of the support, in the unit of the vertices.
        masses: float [V], as for `shot_descriptors`.

    Returns:
        float32 [V, 3, 3], rows x, y, z; NaN where fewer than five vertices are in the support.

    Raises:
        ValueError: As `shot_descriptors`.
    """
    check_support(np.asarray(vertices), radius)
    frames = np.full((len(vertices), 3, 3), np.nan, dtype=np.float32)
    sorted_points = _sorted_by_cell(vertices, radius)
    if sorted_points is not None:
        points, cells, ranges, order = sorted_points
        masses = _sorted_masses(masses, order)
        _frames_kernel(points, masses, cells, ranges, order, float(radius), frames)
    return frames


def _descriptors_and_frames(vertices, normals, radius, bins, pcl_cosine_wrap, masses=None):
    """The descriptors of `shot_descriptors`, and the local frames.

    Returns:
        The descriptors; and the frames, float32 [V, 3, 3], with rows x, y, z, NaN where undefined.
    """
    rows = np.full((len(vertices), SECTORS * (int(bins) + 1)), np.nan, dtype=np.float32)
    frames = np.full((len(vertices), 3, 3), np.nan, dtype=np.float32)
    with np.errstate(over="ignore"):
        directions = normals.astype(np.float32)
    directions[~np.isfinite(directions).all(1)] = np.nan
    sorted_points = _sorted_by_cell(vertices, radius)
    if sorted_points is not None:
        points, cells, ranges, order = sorted_points
        _kernel(
            points,
            np.ascontiguousarray(directions[order].T),
            _sorted_masses(masses, order),
            cells,
            ranges,
            order,
            float(radius),
            int(bins),
            bool(pcl_cosine_wrap),
            rows,
            frames,
        )
    return rows, frames


def _sorted_by_cell(vertices: np.ndarray, radius: float) -> tuple[np.ndarray, ...] | None:
    """The vertices with finite float32 coordinates, sorted by the cell of a search grid.

    Returns:
        The points, float32 [3, N]; `cells` and `ranges` of `_candidate_ranges`; and the vertex of
        every point, int64 [N]. None if N is 0.
    """
    with np.errstate(over="ignore"):
        points = vertices.astype(np.float32)
    usable = np.flatnonzero(np.isfinite(points).all(1))
    if not len(usable):
        return None
    keys = _cell_keys(points[usable], float(radius))
    order = np.lexsort((*points[usable].T, keys))
    cells, ranges = _candidate_ranges(keys[order])
    order = usable[order]
    return np.ascontiguousarray(points[order].T), cells, ranges, order


def _sorted_masses(masses: np.ndarray | None, order: np.ndarray) -> np.ndarray:
    """The masses of the sorted points, float64 [N]; 1 for None."""
    return np.ones(len(order)) if masses is None else np.asarray(masses, np.float64)[order]


def _cell_keys(points: np.ndarray, radius: float) -> np.ndarray:
    """The cell of every point in a cubic grid.

    Args:
        points: float32 [N, 3].
        radius: The edge of the cells.

    Returns:
        int64 [N], the indices of the cell along x, y and z in 21 bits each.
    """
    # slightly wider than the radius, since a rounded distance can fall below it
    steps = (points - points.min(0).astype(np.float64)) / (radius * (1 + 1e-6))
    # points beyond the last cell share it: slower, but neighbours stay in adjacent cells
    x, y, z = (1 + np.minimum(steps, MOST_CELLS).astype(np.int64)).T
    return (x << 42) | (y << 21) | z


def _candidate_ranges(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points in the 27 cells around every cell in use.

    Args:
        keys: int64 [N], ascending, as `_cell_keys` returns them.

    Returns:
        The cell of every point, int64 [N], counting the C cells in use from 0; and for every such
        cell the points in the 27 cells, as nine ascending ranges [start, stop), int64 [C, 9, 2].
    """
    used, cells = np.unique(keys, return_inverse=True)
    steps = np.array([(i << 42) + (j << 21) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    columns = used[:, None] + steps
    start = np.searchsorted(keys, columns - 1, side="left")
    stop = np.searchsorted(keys, columns + 1, side="right")
    return cells.reshape(-1), np.stack((start, stop), axis=-1)


@njit(cache=True, error_model="numpy")
def _kernel(points, normals, masses, cells, ranges, order, radius, bins, wrap, rows, frames):
    """Compute the descriptors and local frames of all usable points.

    Args:
        points, normals: float32 [3, N], sorted by cell.
        masses: float64 [N].
        cells, ranges: As `_candidate_ranges` returns them.
        order: int64 [N], the vertex of every point.
        radius, bins, wrap: As in `shot_descriptors`.
        rows: float32 [V, 32 * (bins + 1)], written.
        frames: float32 [V, 3, 3], written.
    """
    n = points.shape[1]
    index, square = np.empty(n + 1, np.int64), np.empty(n + 1, np.float32)
    distance = np.empty(n, np.float64)
    offset, mass = np.empty((3, n), np.float32), np.empty(n, np.float64)
    histogram = np.empty(SECTORS * (bins + 1), np.float64)
    limit = np.float32(radius * radius)
    for i in range(n):
        m = _neighbours(points, i, ranges[cells[i]], limit, index, square)
        if m < LEAST_NEIGHBOURS:
            continue
        _offsets(points, masses, i, index, square, m, offset, distance, mass)
        frame = frames[order[i]]
        _local_frame(offset, distance, square, mass, m, radius, frame)
        _vote(offset, distance, mass, normals, index, m, frame, radius, bins, wrap, histogram)
        total = 0.0
        for c in range(len(histogram)):
            total += histogram[c] * histogram[c]
        if total > 0:
            scale = 1 / math.sqrt(total)
            for c in range(len(histogram)):
                rows[order[i], c] = histogram[c] * scale


@njit(cache=True, error_model="numpy")
def _frames_kernel(points, masses, cells, ranges, order, radius, frames):
    """Write the local frames of all usable points; arguments as for `_kernel`."""
    n = points.shape[1]
    index, square = np.empty(n + 1, np.int64), np.empty(n + 1, np.float32)
    distance = np.empty(n, np.float64)
    offset, mass = np.empty((3, n), np.float32), np.empty(n, np.float64)
    limit = np.float32(radius * radius)
    for i in range(n):
        m = _neighbours(points, i, ranges[cells[i]], limit, index, square)
        if m < LEAST_NEIGHBOURS:
            continue
        _offsets(points, masses, i, index, square, m, offset, distance, mass)
        _local_frame(offset, distance, square, mass, m, radius, frames[order[i]])


@njit(cache=True, error_model="numpy")
def _offsets(points, masses, i, index, square, m, offset, distance, mass):
    """Write offsets, float32 [3, N], distances and masses, float64 [N], of the m neighbours."""
    for k in range(m):
        mass[k] = masses[index[k]]
        # in float32, like PCL: where axes are nearly tied, more digits rotate them by 1e-5
        distance[k] = np.sqrt(square[k])
        for axis in range(3):
            offset[axis, k] = points[axis, index[k]] - points[axis, i]


@njit(cache=True, error_model="numpy")
def _neighbours(points, i, ranges, limit, index, square):
    """Find the points k with 0 < |p_k - p_i|^2 < limit, in ascending order.

    Args:
        points: float32 [3, N].
        i: The centre.
        ranges: int64 [9, 2], the candidates.
        limit: float32, the squared radius.
        index: int64 [N+1], receives the points.
        square: float32 [N+1], receives their squared distances.

    Returns:
        The number of points found.
    """
    m = 0
    for r in range(len(ranges)):
        for k in range(ranges[r, 0], ranges[r, 1]):
            x = points[0, k] - points[0, i]
            y = points[1, k] - points[1, i]
            z = points[2, k] - points[2, i]
            d2 = x * x + y * y + z * z
            index[m] = k  # written always, counted only if near: cheaper than a branch
            square[m] = d2
            m += (d2 > 0) & (d2 < limit)
    return m


@njit(cache=True, error_model="numpy")
def _local_frame(offset, distance, square, mass, m, radius, frame):
    """Write the local frame: the axes of the neighbours' weighted covariance.

    x is the eigenvector of the largest eigenvalue, z that of the smallest, and y their cross
    product z x x.

    Args:
        offset: float32 [3, N], the neighbours relative to the centre.
        distance: float64 [N], their distances.
        square: float32 [N], their squared distances.
        mass: float64 [N], their masses.
        m: Number of neighbours.
        radius: Neighbours weigh (radius - distance) times their mass.
        frame: float32 [3, 3], receives the axes as rows.
    """
    xx = xy = xz = yy = yz = zz = total = 0.0
    for k in range(m):
        x, y, z = np.float64(offset[0, k]), np.float64(offset[1, k]), np.float64(offset[2, k])
        w = (radius - distance[k]) * mass[k]
        total += w
        xx += w * x * x
        xy += w * x * y
        xz += w * x * z
        yy += w * y * y
        yz += w * y * z
        zz += w * z * z
    if total == 0:  # all distances round to the radius: the axes stay NaN
        return
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) / total
    vectors = _eigenvectors(matrix)
    largest, smallest = 0, 0
    for c in range(1, 3):
        largest = c if matrix[c, c] > matrix[largest, largest] else largest
        smallest = c if matrix[c, c] <= matrix[smallest, smallest] else smallest
    for row, column in ((0, largest), (2, smallest)):
        a, b, c = vectors[0, column], vectors[1, column], vectors[2, column]
        sign = 1.0 if _points_along(offset, square, mass, m, a, b, c) else -1.0
        frame[row, 0], frame[row, 1], frame[row, 2] = sign * a, sign * b, sign * c
    x, z = frame[0], frame[2]
    frame[1, 0] = z[1] * x[2] - z[2] * x[1]
    frame[1, 1] = z[2] * x[0] - z[0] * x[2]
    frame[1, 2] = z[0] * x[1] - z[1] * x[0]


@njit(cache=True, error_model="numpy")
def _eigenvectors(a):
    """The eigenvectors of a symmetric matrix by Jacobi's method, without SciPy as numba's own has.

    Args:
        a: float64 [3, 3], overwritten; its diagonal becomes the eigenvalues.

    Returns:
        float64 [3, 3], the unit eigenvectors as columns.
    """
    v = np.eye(3)
    for _ in range(20):
        off = abs(a[0, 1]) + abs(a[0, 2]) + abs(a[1, 2])
        if not off > 1e-40 * (abs(a[0, 0]) + abs(a[1, 1]) + abs(a[2, 2])):
            break
        for p, q in ((0, 1), (0, 2), (1, 2)):
            if a[p, q] == 0:
                continue
            theta = (a[q, q] - a[p, p]) / (2 * a[p, q])
            t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1))
            c = 1 / math.sqrt(t * t + 1)
            s = t * c
            for k in range(3):
                a[k, p], a[k, q] = c * a[k, p] - s * a[k, q], s * a[k, p] + c * a[k, q]
                v[k, p], v[k, q] = c * v[k, p] - s * v[k, q], s * v[k, p] + c * v[k, q]
            for k in range(3):
                a[p, k], a[q, k] = c * a[p, k] - s * a[q, k], s * a[p, k] + c * a[q, k]
            a[p, q] = a[q, p] = 0.0
    return v


@njit(cache=True, error_model="numpy")
def _points_along(offset, square, mass, m, a, b, c):
    """Whether most mass of the m neighbours lies on the side that the axis (a, b, c) points to.

    A tie is decided by the majority of the five neighbours around the median distance.
    """
    side, total = 0.0, 0.0
    for k in range(m):
        total += mass[k]
        side += mass[k] * (a * offset[0, k] + b * offset[1, k] + c * offset[2, k] >= 0)
    if 2 * side != total:
        return 2 * side > total
    count = 0
    nearest = np.argsort(square[:m], kind="mergesort")  # stable: equal distances stay in order
    for k in nearest[m // 2 - 2 : m // 2 + 3]:
        count += a * offset[0, k] + b * offset[1, k] + c * offset[2, k] > 0
    return count >= 3


@njit(cache=True, error_model="numpy")
def _vote(offset, distance, mass, normals, index, m, frame, radius, bins, wrap, histogram):
    """Fill the histogram from the m neighbours, before normalisation.

    A neighbour falls into one cell. In each of four coordinates (cosine, radius, elevation,
    azimuth) it lies e cell widths from the centre of that cell. The cell gets 1 - |e|, and the next
    cell on that side gets |e|, if there is one.

    Args:
        offset, distance, mass, m, radius: As in `_local_frame`.
        normals: float32 [3, N].
        index: int64 [N+1], the neighbours.
        frame: float32 [3, 3], the local frame.
        bins, wrap: As in `shot_descriptors`.
        histogram: float64 [32 * (bins + 1)], written.
    """
    histogram[:] = 0.0
    for k in range(m):
        j = index[k]
        nx, ny, nz = normals[0, j], normals[1, j], normals[2, j]
        cosine = np.float64(nx * frame[2, 0] + ny * frame[2, 1] + nz * frame[2, 2])
        if math.isnan(cosine):
            continue
        dx, dy, dz, d = offset[0, k], offset[1, k], offset[2, k], distance[k]
        x = dx * frame[0, 0] + dy * frame[0, 1] + dz * frame[0, 2]
        y = dx * frame[1, 0] + dy * frame[1, 1] + dz * frame[1, 2]
        z = dx * frame[2, 0] + dy * frame[2, 1] + dz * frame[2, 2]

        position = (1 + min(max(cosine, -1.0), 1.0)) * bins / 2
        bin_ = int(position + 0.5)
        azimuth, azimuth_offset = eighth(x, y)
        outer, upper = int(d > radius / 2), int(z > 0)
        sector = 4 * azimuth + 2 * outer + upper
        cell = sector * (bins + 1) + bin_

        e = position - bin_
        weight = 1 - abs(e)
        if e > 0:
            histogram[cell - bin_ if wrap and bin_ == bins - 1 else cell + 1] += mass[k] * e
        elif e < 0:
            histogram[cell - 1] -= mass[k] * e

        e = 2 * d / radius - (1.5 if outer else 0.5)
        weight += 1 - abs(e)
        histogram[(sector ^ 2) * (bins + 1) + bin_] += mass[k] * max(-e if outer else e, 0.0)

        e = arccos(min(max(z / d, -1.0), 1.0)) * (2 / math.pi) - (0.5 if upper else 1.5)
        weight += 1 - abs(e)
        histogram[(sector ^ 1) * (bins + 1) + bin_] += mass[k] * max(e if upper else -e, 0.0)

        if x != 0 or y != 0:
            weight += 1 - abs(azimuth_offset)
            beside = (sector + (4 if azimuth_offset > 0 else -4)) % SECTORS
            histogram[beside * (bins + 1) + bin_] += mass[k] * abs(azimuth_offset)
        histogram[cell] += mass[k] * weight
