"""The fast angles agree with NumPy's within the documented errors."""

from __future__ import annotations

import numpy as np

from meshspiral.geometry.angles import arccos, arctan, eighth


def test_arctan_and_arccos_agree_with_numpy():
    for t in np.linspace(0, 1, 1001):
        assert abs(arctan(t) - np.arctan(t)) < 2e-8
        assert abs(arccos(t) - np.arccos(t)) < 2.2e-8
        assert abs(arccos(-t) - np.arccos(-t)) < 2.2e-8


def test_an_eighth_includes_its_upper_border():
    borders = [(-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0)]
    assert [eighth(x, y)[0] for x, y in borders] == list(range(8))
    assert eighth(-1.0, -0.0)[0] == 7
    assert eighth(0.0, 0.0)[0] == 0


def test_eighth_and_position_give_the_angle():
    for angle in np.linspace(-np.pi, np.pi, 1003)[1:-1]:
        number, position = eighth(2 * np.cos(angle), 2 * np.sin(angle))
        assert abs(-np.pi + (number + 0.5 + position) * np.pi / 4 - angle) < 3e-8
        assert abs(position) <= 0.5 + 3e-8
