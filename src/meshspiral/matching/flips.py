"""Left and right put back where a network took one for the other.

A body and its mirror image are isometric, so a network that sees neighbourhoods alone takes a left
hand for a right one now and then, often with the whole arm. The labels then jump where the arm
meets the body, from one side of the template to the other, and there is no jump if all labels of
the arm are replaced by their mirror images.
"""

from __future__ import annotations

import numpy as np
from trimesh.graph import connected_component_labels

from meshspiral.geometry.faces import directed_edges
from meshspiral.geometry.kdtree import kd_tree
from meshspiral.geometry.mesh import Mesh

JUMP = 0.1  # over sqrt(area) of the template: the least distance of labels that jump
REMAINING = 0.5  # largest share of the jumps around a piece that remains if it took left for right
ROUNDS = 20
ASYMMETRY = 0.03  # over sqrt(area): mean distance of a mirror image from the nearest vertex


def mirror_images(template: Mesh, up: str) -> np.ndarray | None:
    """The vertex nearest to the mirror image of each, for a template that is its own mirror image.

    Args:
        template: K vertices.
        up: Its axis that points up, "y" or "z". The mirror contains it and another axis.

    Returns:
        int64 [K]; None if the images are on average further than ASYMMETRY from a vertex.
    """
    vertices = template.vertices / template.size
    tree, found = kd_tree(vertices), []
    for axis in {0, 1, 2} - {"xyz".index(up)}:
        images = vertices.copy()
        images[:, axis] = vertices[:, axis].min() + vertices[:, axis].max() - images[:, axis]
        distances, nearest = tree.query(images)
        found.append((distances.mean() / np.ptp(images[:, axis]), axis, distances.mean(), nearest))
    _, _, asymmetry, nearest = min(found)  # a flat shape is near any image from front to back
    return nearest if asymmetry < ASYMMETRY else None


def sides_of(template: Mesh, mirror: np.ndarray) -> np.ndarray:
    """On which side of the mirror each vertex is, int8 [K]: 1, -1, or 0 near it.

    Args:
        template: K vertices.
        mirror: int [K], from `mirror_images`.
    """
    across = template.vertices - template.vertices[mirror]
    across = across[:, np.abs(across).mean(axis=0).argmax()]
    return (np.sign(across) * (np.abs(across) > template.mean_edge)).astype(np.int8)


def without_flips(labels: np.ndarray, mesh: Mesh, template: Mesh, mirror: np.ndarray) -> np.ndarray:
    """Replace the labels of pieces that took left for right by their mirror images.

    The mesh is cut into pieces along the edges at which labels jump. A piece takes the mirror
    images if at most REMAINING of its jumps to other pieces are left then; of two that meet, the
    smaller one does so first. The piece with the largest area stays.

    Args:
        labels: int [W], vertices of the template.
        mesh: W vertices.
        template: K vertices.
        mirror: int [K], from `mirror_images`.

    Returns:
        int [W].
    """
    places, areas = template.vertices / template.size, mesh.vertex_areas
    edges = np.unique(np.sort(directed_edges(mesh.faces), axis=1), axis=0).T

    def jump(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.linalg.norm(places[a] - places[b], axis=1) > JUMP

    for _ in range(ROUNDS):
        cut = jump(*labels[edges])
        piece = connected_component_labels(edges[:, ~cut].T, node_count=len(labels))
        cut &= piece[edges[0]] != piece[edges[1]]  # else another way leads around the jump
        ends, (a, b) = piece[edges[:, cut]], labels[edges[:, cut]]
        sizes = np.bincount(piece, areas)
        jumps = np.bincount(ends.ravel(), minlength=len(sizes))
        after = np.concatenate([jump(mirror[a], b), jump(a, mirror[b])])
        gain = jumps - np.bincount(ends.ravel(), after, minlength=len(sizes))
        better = (jumps > 0) & (gain >= (1 - REMAINING) * jumps)
        better[sizes.argmax()] = False
        if not better.any():
            break
        # of two pieces that meet, the larger one waits for the next round
        first, second = ends[:, better[ends].all(axis=0)]
        better[np.where(sizes[first] < sizes[second], second, first)] = False
        labels = np.where(better[piece], mirror[labels], labels)
    return labels
