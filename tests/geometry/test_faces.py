"""Operations on arrays of faces."""

from __future__ import annotations

import numpy as np

from meshspiral.geometry.faces import directed_edges, surplus, without_repeats


def test_directed_edges_follow_the_corners_of_each_face():
    edges = directed_edges(np.array([[0, 1, 2], [1, 0, 3]]))
    assert edges.tolist() == [[0, 1], [1, 2], [2, 0], [1, 0], [0, 3], [3, 1]]


def test_a_third_face_at_an_edge_is_surplus():
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    assert surplus(faces, 5).tolist() == [2]
    assert surplus(faces[:2], 5).tolist() == []


def test_degenerate_faces_are_removed_and_repeated_ones_stay_once():
    faces = np.array([[0, 1, 2], [2, 1, 0], [3, 3, 1], [1, 2, 3]])
    np.testing.assert_array_equal(without_repeats(faces), faces[[0, 3]])
