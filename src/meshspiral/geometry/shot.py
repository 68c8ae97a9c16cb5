"""SHOT: signatures of histograms of orientations, a local descriptor of a surface at its vertices.

Salti, Tombari, Di Stefano, "SHOT: Unique signatures of histograms for surface and texture
description", Computer Vision and Image Understanding 125 (2014). The paper leaves much open; what
is computed here is the algorithm of the Point Cloud Library (PCL) 1.13, to within 1e-5.

Descriptors published for FAUST were made with a unit-dependent variant (weights R - d^2 in the
local frame, an azimuth modulus of 28) and cannot be reproduced exactly; that variant is not here.

Votes jump where a neighbour crosses the border of a cell of the histogram, and axes flip where the
votes on their signs tie. Rounding alone therefore changes some rows, under 1 %, of a rotated mesh.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from meshspiral.geometry.angles import arccos, eighth

SECTORS = 32  # 8 of azimuth x 2 of radius x 2 of elevation
LEAST_NEIGHBOURS = 5  # away from the centre; with fewer there is no local frame
MOST_CELLS = 2**21 - 3  # along an axis of the search grid, so that three indices fit an int64


def shot_descriptors(
    vertices: np.ndarray,
    normals: np.ndarray,
    radius: float,
    bins: int = 16,
    pcl_cosine_wrap: bool = False,
) -> np.ndarray:
    """SHOT descriptor of every vertex: float32 [V, 32 * (bins + 1)], rows of unit L2 norm.

    vertices: float [V, 3], any unit of length; rounded to float32, as in PCL, so a mesh should not
    lie farther from the origin than some multiples of its size. normals: float [V, 3], unit
    length. radius: of the support and of the local frame, in the unit of the vertices; usual is
    0.06 * sqrt(surface area). bins: steps of the cosine between a neighbour's normal and
    the z axis; 16 gives 544 dimensions, 10 gives 352. pcl_cosine_wrap: PCL lets the cosine votes
    of bin `bins - 1` towards bin `bins` go to bin 0, a slip that the authors' own code has
    corrected; True repeats it, to compare with values from PCL.

    Column: (4 * azimuth + 2 * outer + upper) * (bins + 1) + bin.

    A row is NaN where the descriptor is undefined: fewer than five neighbours at other coordinates
    than the vertex's own and nearer than the radius, no such neighbour with a finite normal, or
    coordinates that are not finite. A vertex with such coordinates is nobody's neighbour. A vertex
    whose normal is not finite counts in the local frames but casts no votes; a normal of zero
    length votes as one perpendicular to z.

    Renumbering the vertices permutes the rows: sums and ties of distance follow the order of
    coordinates, where PCL follows the numbers of the vertices. Two things remain: sums over points
    at equal coordinates follow the numbers, within float64 rounding; and a mesh with exact ties,
    such as a plain icosphere, depends on how it is turned.

    Errors: ValueError for other shapes, bins < 1, and a radius that is not positive and finite, or
    whose square is not, in float32.
    """
    vertices, normals = np.asarray(vertices), np.asarray(normals)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"vertices must be [V, 3], got {vertices.shape}")
    if normals.shape != vertices.shape:
        raise ValueError(f"normals must be {vertices.shape}, as the vertices, got {normals.shape}")
    if not isinstance(bins, (int, np.integer)) or bins < 1:
        raise ValueError(f"bins must be an integer of at least 1, got {bins}")
    with np.errstate(over="ignore", under="ignore"):
        square = np.float32(float(radius) * float(radius))
    if not (radius > 0 and 0 < square < np.inf):
        raise ValueError(f"radius must be positive and finite, also its square, got {radius}")
    return _descriptors_and_frames(vertices, normals, radius, bins, pcl_cosine_wrap)[0]


def _descriptors_and_frames(vertices, normals, radius, bins, pcl_cosine_wrap):
    """The descriptors, and the local frames: float32 [V, 3, 3], rows x, y, z, or NaN."""
    rows = np.full((len(vertices), SECTORS * (int(bins) + 1)), np.nan, dtype=np.float32)
    frames = np.full((len(vertices), 3, 3), np.nan, dtype=np.float32)
    with np.errstate(over="ignore"):
        points, directions = vertices.astype(np.float32), normals.astype(np.float32)
    directions[~np.isfinite(directions).all(1)] = np.nan
    usable = np.flatnonzero(np.isfinite(points).all(1))
    if len(usable):
        keys = _cell_keys(points[usable], float(radius))
        order = np.lexsort((*points[usable].T, keys))
        cells, ranges = _candidate_ranges(keys[order])
        order = usable[order]
        _kernel(
            np.ascontiguousarray(points[order].T),
            np.ascontiguousarray(directions[order].T),
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


def _cell_keys(points: np.ndarray, radius: float) -> np.ndarray:
    """int64 [N]: the cell of a grid of edge `radius` each point is in, 21 bits for an axis."""
    # a hair wider than the radius, since a rounded distance can fall below it
    steps = (points - points.min(0).astype(np.float64)) / (radius * (1 + 1e-6))
    # points beyond the last cell share it: slower, but neighbours stay in adjacent cells
    x, y, z = (1 + np.minimum(steps, MOST_CELLS).astype(np.int64)).T
    return (x << 42) | (y << 21) | z


def _candidate_ranges(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For ascending keys [N]: each point's cell, int64 [N], and the points in the 27 cells around
    each of the C cells in use, as nine ascending ranges [start, stop): int64 [C, 9, 2]."""
    used, cells = np.unique(keys, return_inverse=True)
    steps = np.array([(i << 42) + (j << 21) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    columns = used[:, None] + steps
    start = np.searchsorted(keys, columns - 1, side="left")
    stop = np.searchsorted(keys, columns + 1, side="right")
    return cells.reshape(-1), np.stack((start, stop), axis=-1)


@njit(cache=True, error_model="numpy")
def _kernel(points, normals, cells, ranges, order, radius, bins, wrap, rows, frames):
    """Fill rows [V, 32 * (bins + 1)] and frames [V, 3, 3] at `order`.

    points, normals: float32 [3, N], sorted by cell. The others as in the functions above.
    """
    n = points.shape[1]
    index, square = np.empty(n + 1, np.int64), np.empty(n + 1, np.float32)
    distance = np.empty(n, np.float64)
    offset = np.empty((3, n), np.float32)
    histogram = np.empty(SECTORS * (bins + 1), np.float64)
    limit = np.float32(radius * radius)
    for i in range(n):
        m = _neighbours(points, i, ranges[cells[i]], limit, index, square)
        if m < LEAST_NEIGHBOURS:
            continue
        for k in range(m):
            # in float32, as PCL: where axes are nearly tied, more digits here turn them by 1e-5
            distance[k] = np.sqrt(square[k])
            for axis in range(3):
                offset[axis, k] = points[axis, index[k]] - points[axis, i]
        frame = frames[order[i]]
        _local_frame(offset, distance, square, m, radius, frame)
        _vote(offset, distance, normals, index, m, frame, radius, bins, wrap, histogram)
        total = 0.0
        for c in range(len(histogram)):
            total += histogram[c] * histogram[c]
        if total > 0:
            scale = 1 / math.sqrt(total)
            for c in range(len(histogram)):
                rows[order[i], c] = histogram[c] * scale


@njit(cache=True, error_model="numpy")
def _neighbours(points, i, ranges, limit, index, square):
    """List the points k with 0 < |p_k - p_i|^2 < limit, ascending; return their number."""
    m = 0
    for r in range(len(ranges)):
        for k in range(ranges[r, 0], ranges[r, 1]):
            x = points[0, k] - points[0, i]
            y = points[1, k] - points[1, i]
            z = points[2, k] - points[2, i]
            d2 = x * x + y * y + z * z
            index[m] = k  # always written, kept by the count: cheaper than a branch
            square[m] = d2
            m += (d2 > 0) & (d2 < limit)
    return m


@njit(cache=True, error_model="numpy")
def _local_frame(offset, distance, square, m, radius, frame):
    """Write the axes x, y, z of the m neighbours' weighted covariance to frame, float32 [3, 3].

    x is the eigenvector of the largest eigenvalue, z of the smallest; y = z x x.
    """
    xx = xy = xz = yy = yz = zz = total = 0.0
    for k in range(m):
        x, y, z = np.float64(offset[0, k]), np.float64(offset[1, k]), np.float64(offset[2, k])
        w = radius - distance[k]
        total += w
        xx += w * x * x
        xy += w * x * y
        xz += w * x * z
        yy += w * y * y
        yz += w * y * z
        zz += w * z * z
    if total == 0:  # every neighbour at the radius itself, as rounded: the axes stay NaN
        return
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) / total
    vectors = _eigenvectors(matrix)
    largest, smallest = 0, 0
    for c in range(1, 3):
        largest = c if matrix[c, c] > matrix[largest, largest] else largest
        smallest = c if matrix[c, c] <= matrix[smallest, smallest] else smallest
    for row, column in ((0, largest), (2, smallest)):
        a, b, c = vectors[0, column], vectors[1, column], vectors[2, column]
        sign = 1.0 if _points_along(offset, square, m, a, b, c) else -1.0
        frame[row, 0], frame[row, 1], frame[row, 2] = sign * a, sign * b, sign * c
    x, z = frame[0], frame[2]
    frame[1, 0] = z[1] * x[2] - z[2] * x[1]
    frame[1, 1] = z[2] * x[0] - z[0] * x[2]
    frame[1, 2] = z[0] * x[1] - z[1] * x[0]


@njit(cache=True, error_model="numpy")
def _eigenvectors(a):
    """Unit eigenvectors, the columns of float64 [3, 3], of the symmetric a, by Jacobi's method.

    a is overwritten; its diagonal becomes the eigenvalues. (numba's own needs SciPy.)
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
def _points_along(offset, square, m, a, b, c):
    """Whether most of the m neighbours lie on the side that the axis (a, b, c) points to.

    A draw goes to the majority of the five neighbours about the median distance.
    """
    count = 0
    for k in range(m):
        count += a * offset[0, k] + b * offset[1, k] + c * offset[2, k] >= 0
    if 2 * count != m:
        return 2 * count > m
    count = 0
    nearest = np.argsort(square[:m], kind="mergesort")  # stable: equal distances stay in order
    for k in nearest[m // 2 - 2 : m // 2 + 3]:
        count += a * offset[0, k] + b * offset[1, k] + c * offset[2, k] > 0
    return count >= 3


@njit(cache=True, error_model="numpy")
def _vote(offset, distance, normals, index, m, frame, radius, bins, wrap, histogram):
    """Fill the histogram, float64 [32 * (bins + 1)], from the m neighbours, before scaling.

    A neighbour falls into one cell and, in each of four coordinates, lies at some share e of a
    cell's width from that cell's centre: the cell gets 1 - |e|, the next one on that side |e|,
    where there is one.
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

        place = (1 + min(max(cosine, -1.0), 1.0)) * bins / 2
        bin_ = int(place + 0.5)
        azimuth, turned = eighth(x, y)
        outer, upper = int(d > radius / 2), int(z > 0)
        sector = 4 * azimuth + 2 * outer + upper
        cell = sector * (bins + 1) + bin_

        e = place - bin_
        weight = 1 - abs(e)
        if e > 0:
            histogram[cell - bin_ if wrap and bin_ == bins - 1 else cell + 1] += e
        elif e < 0:
            histogram[cell - 1] -= e

        e = 2 * d / radius - (1.5 if outer else 0.5)
        weight += 1 - abs(e)
        histogram[(sector ^ 2) * (bins + 1) + bin_] += max(-e if outer else e, 0.0)

        e = arccos(min(max(z / d, -1.0), 1.0)) * (2 / math.pi) - (0.5 if upper else 1.5)
        weight += 1 - abs(e)
        histogram[(sector ^ 1) * (bins + 1) + bin_] += max(e if upper else -e, 0.0)

        if x != 0 or y != 0:
            weight += 1 - abs(turned)
            beside = (sector + (4 if turned > 0 else -4)) % SECTORS
            histogram[beside * (bins + 1) + bin_] += abs(turned)
        histogram[cell] += weight
