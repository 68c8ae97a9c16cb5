"""Operations on arrays of triangles, int [F, 3], that need no coordinates."""

from __future__ import annotations

import numpy as np


def directed_edges(faces: np.ndarray) -> np.ndarray:
    """The three directed edges of every face.

    Args:
        faces: int [F, 3], vertex indices.

    Returns:
        int [3 F, 2]; row 3 f + k leads from corner k of face f to its next corner.
    """
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def without_repeats(faces: np.ndarray) -> np.ndarray:
    """The faces with three different vertices, each set of vertices once.

    Args:
        faces: int [F, 3], vertex indices.

    Returns:
        int [G, 3]: of faces with the same three vertices the first one, in the given order.
    """
    ordered = np.sort(faces, axis=1)
    proper = (ordered[:, 0] < ordered[:, 1]) & (ordered[:, 1] < ordered[:, 2])
    _, first = np.unique(ordered[proper], axis=0, return_index=True)
    return faces[proper][np.sort(first)]


def surplus(faces: np.ndarray, vertices: int) -> np.ndarray:
    """The faces that repeat a directed edge of an earlier face.

    Without them every edge has at most two faces, and these are wound alike.

    Args:
        faces: int [F, 3], vertex indices.
        vertices: Number of vertices V.

    Returns:
        int64 [K], ascending indices of faces.
    """
    edges = directed_edges(faces).astype(np.int64)
    keys = edges[:, 0] * vertices + edges[:, 1]
    _, first = np.unique(keys, return_index=True)
    repeated = np.setdiff1d(np.arange(len(keys)), first)
    return np.unique(repeated // 3)
