"""The template's connectivity on a labelled mesh: the inverse of its labels."""

from __future__ import annotations

import numpy as np
from scipy.sparse import diags_array
from scipy.sparse.linalg import spsolve

from meshspiral.geometry.barycentric import interpolate
from meshspiral.geometry.laplacian import laplacian
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.remesh import closest_points
from meshspiral.matching.job import LabelledScan

STRETCH = 4.0  # times the template's mean edge, beyond which a face of labels is a wrong one
REACH = 2.0  # times the template's mean edge, beyond which a template vertex has no counterpart
FLAT = 1e-6  # area over that of a square on the mean edge, below which corners lie on a line
STIFFNESS = 0.02  # of the surface where counterparts are sure


def registered(labelled: LabelledScan, template: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """The template's vertices, moved onto a labelled mesh.

    The labels of a face's corners span a face on the template. A template vertex goes to the point
    of the mesh whose label is nearest to it. Weighted by confidence, these points then attract a
    surface with the template's connectivity that is smooth otherwise: it minimises
    sum_k w_k |x_k - p_k|^2 + STIFFNESS sum |L x|^2, with the cotangent Laplacian L over the masses
    (Sorkine, Cohen-Or, "Least-squares meshes", 2004).

    Args:
        labelled: The mesh and its labels.
        template: Mesh with K vertices.

    Returns:
        Positions, float64 [K, 3], in the mesh's coordinates, NaN if no point of the mesh has a
        usable label; and the confidence of each, float [K]: 0 where no point of the mesh has a
        label near the vertex.
    """
    mesh, labels = labelled.scan.mesh, labelled.labels
    points, confidence = labelled.on_mesh(labels.points), labelled.on_mesh(labels.confidence)
    edge = template.mean_edge
    sound = spanning_faces(points, mesh.faces, template)
    found = np.zeros((len(template.vertices), 3))
    weights = np.zeros(len(template.vertices))
    if sound.any():
        spanned = Mesh(np.nan_to_num(points), mesh.faces[sound])
        face, barycentric, far = closest_points(spanned, template.vertices, template.vertex_normals)
        corners = spanned.faces[face]
        found = interpolate(mesh.vertices, corners, barycentric)
        sure = (confidence[corners] * barycentric).sum(axis=1)
        weights = np.where(far < REACH * edge, np.maximum(sure, 1e-3), 0.0)
    if not weights.any():
        return np.full((len(weights), 3), np.nan), weights
    stiffness, masses = laplacian(template)
    smooth = edge**2 * (diags_array(1 / masses) @ stiffness)
    matrix = diags_array(weights) + STIFFNESS * (smooth.T @ smooth)
    return spsolve(matrix.tocsc(), weights[:, None] * found), weights


def spanning_faces(points: np.ndarray, faces: np.ndarray, template: Mesh) -> np.ndarray:
    """Whether the labels of a face's corners span a face on the template, bool [F].

    Not if they are further apart than STRETCH mean edges of the template, since one of them is then
    wrong; nor if they lie on a line.

    Args:
        points: float [W, 3], labels of vertices; NaN for none.
        faces: int [F, 3].
        template: The template of the labels.
    """
    corners = points[faces]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    edge = template.mean_edge
    wide = np.linalg.norm(normals, axis=1) > FLAT * edge**2
    return wide & (sides.max(axis=1) < STRETCH * edge)
