"""Angles from within compiled loops, for millions of points.

The polynomials are those of Abramowitz and Stegun, "Handbook of Mathematical Functions" (1964). No
branch depends on the point: it would cost more than the arithmetic.
"""

from __future__ import annotations

import math

from numba import njit


@njit(cache=True, error_model="numpy")
def eighth(x, y):
    """Which half-open eighth (-pi + a pi/4, -pi + (a + 1) pi/4] the angle of (x, y) is in,
    a = 0..7, and where in it: from -0.5 to 0.5, float64 within 3e-8.

    The eighth is found by comparisons alone, so that rounding cannot move a point on a border. At
    the origin it is 0, and the place in it NaN.
    """
    above = (y > 0) | ((y == 0) & (x < 0))
    x, y = (-x, -y) if above else (x, y)
    left = x <= 0
    along, across = (-x, -y) if left else (-y, x)  # the quadrant's axis, and the next
    far = across > along
    share = arctan(min(along, across) / max(along, across)) * (4 / math.pi)
    return 4 * above + 2 * (not left) + far, (0.5 - share if far else share - 0.5)


@njit(cache=True, error_model="numpy")
def arctan(t):
    """The angle of a tangent t in 0..1, within 2e-8 (4.4.49)."""
    s = t * t
    series = (
        (((0.0028662257 * s - 0.0161657367) * s + 0.0429096138) * s - 0.0752896400) * s
        + 0.1065626393
    ) * s - 0.1420889944
    return t * (((series * s + 0.1999355085) * s - 0.3333314528) * s + 1)


@njit(cache=True, error_model="numpy")
def arccos(t):
    """The angle of a cosine t in -1..1, within 2.2e-8 (4.4.46)."""
    s = abs(t)
    series = (
        (((-0.0012624911 * s + 0.0066700901) * s - 0.0170881256) * s + 0.0308918810) * s
        - 0.0501743046
    ) * s + 0.0889789874
    angle = math.sqrt(1 - s) * ((series * s - 0.2145988016) * s + 1.5707963050)
    return angle if t >= 0 else math.pi - angle
