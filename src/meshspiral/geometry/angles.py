"""Fast arctan, arccos and octants for compiled loops over millions of points.

The polynomials are those of Abramowitz and Stegun, "Handbook of Mathematical Functions" (1964). No
branch depends on the values: branches would cost more than the arithmetic.
"""

from __future__ import annotations

import math

from numba import njit


@njit(cache=True, error_model="numpy")
def eighth(x, y):
    """The eighth of the circle that holds the direction (x, y), and the position inside it.

    Eighth a is the half-open interval (-pi + a pi/4, -pi + (a + 1) pi/4] of angles. It is found by
    comparisons alone, so rounding cannot move a direction across a border.

    Args:
        x: First coordinate of the direction.
        y: Second coordinate of the direction.

    Returns:
        The eighth a = 0..7, and the position in it: float64 from -0.5 at the lower border to 0.5 at
        the upper one, within 3e-8. The origin gives 0 and NaN.
    """
    above = (y > 0) | ((y == 0) & (x < 0))
    x, y = (-x, -y) if above else (x, y)
    left = x <= 0
    along, across = (-x, -y) if left else (-y, x)  # along the quadrant's first axis, and its second
    far = across > along
    fraction = arctan(min(along, across) / max(along, across)) * (4 / math.pi)
    return 4 * above + 2 * (not left) + far, (0.5 - fraction if far else fraction - 0.5)


@njit(cache=True, error_model="numpy")
def arctan(t):
    """The arctangent of t in 0..1, in radians, within 2e-8 (formula 4.4.49)."""
    s = t * t
    series = (
        (((0.0028662257 * s - 0.0161657367) * s + 0.0429096138) * s - 0.0752896400) * s
        + 0.1065626393
    ) * s - 0.1420889944
    return t * (((series * s + 0.1999355085) * s - 0.3333314528) * s + 1)


@njit(cache=True, error_model="numpy")
def arccos(t):
    """The arccosine of t in -1..1, in radians, within 2.2e-8 (formula 4.4.46)."""
    s = abs(t)
    series = (
        (((-0.0012624911 * s + 0.0066700901) * s - 0.0170881256) * s + 0.0308918810) * s
        - 0.0501743046
    ) * s + 0.0889789874
    angle = math.sqrt(1 - s) * ((series * s - 0.2145988016) * s + 1.5707963050)
    return angle if t >= 0 else math.pi - angle
