"""Maps to points in the target's faces, and values that are carried along them."""

from __future__ import annotations

import numpy as np

from meshspiral.geometry.barycentric import interpolate
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.remesh import closest_points
from meshspiral.matching.job import FileMatch, LabelledScan
from meshspiral.matching.registration import spanning_faces
from meshspiral.matching.transfer import transfer


def dense_map(
    source: LabelledScan, target: LabelledScan, template: Mesh
) -> tuple[np.ndarray, np.ndarray]:
    """For every source vertex a point in a face of the target: where the labels are nearest.

    Faces of the target whose labels do not span a face are left out, see `spanning_faces`.

    Returns:
        Vertices of the target's faces, int64 [V, 3], -1 for none; and barycentric coordinates,
        float64 [V, 3].
    """
    points, mesh = target.on_mesh(target.labels.points), target.scan.mesh
    sound = spanning_faces(points, mesh.faces, template)
    count = len(source.labels.template)
    found, weights = np.full((count, 3), -1), np.zeros((count, 3))
    known = source.labels.template >= 0
    if sound.any() and known.any():
        spanned = Mesh(np.nan_to_num(points), mesh.faces[sound])
        queries = source.labels.points[known]
        face, weights[known], _ = closest_points(spanned, queries, np.full_like(queries, np.nan))
        found[known] = target.scan.origin[spanned.faces[face]]
    return found, weights


def carried(values: np.ndarray, match: FileMatch, template: Mesh) -> np.ndarray:
    """Values of the target's vertices at the points of `dense_map`, interpolated in their faces.

    Where there is no such point, the value is that of the vertex of `match.map`.

    Args:
        values: float [W, D], one row per vertex of the target's file.
        match: With a target.
        template: The template of the labels.

    Returns:
        float [V, D], one row per vertex of the source's file; 0 where the map is -1.
    """
    found = transfer(values, match.map, 0.0)
    corners, weights = dense_map(match.source, match.target, template)
    known = corners[:, 0] >= 0
    found[known] = interpolate(values, corners[known], weights[known])
    return found
