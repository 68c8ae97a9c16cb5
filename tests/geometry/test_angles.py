"""The fast angles against NumPy's."""

from __future__ import annotations

import numpy as np

from meshspiral.geometry.angles import arccos, arctan, eighth


def test_fast_angles_are_those_of_numpy():
    for t in np.linspace(0, 1, 1001):
        assert abs(arctan(t) - np.arctan(t)) < 2e-8
        assert abs(arccos(t) - np.arccos(t)) < 2.2e-8
        assert abs(arccos(-t) - np.arccos(-t)) < 2.2e-8


def test_eighths_hold_their_upper_border():
    ends = [(-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0)]
    assert [eighth(x, y)[0] for x, y in ends] == list(range(8))
    assert eighth(-1.0, -0.0)[0] == 7
    assert eighth(0.0, 0.0)[0] == 0


def test_the_place_in_an_eighth_is_that_of_the_angle():
    for angle in np.linspace(-np.pi, np.pi, 1003)[1:-1]:
        number, place = eighth(2 * np.cos(angle), 2 * np.sin(angle))
        assert abs(-np.pi + (number + 0.5 + place) * np.pi / 4 - angle) < 3e-8
        assert abs(place) <= 0.5 + 3e-8
