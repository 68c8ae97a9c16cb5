"""Colours of vertices: by point on the template, by error, by confidence, by any values."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps

from meshspiral.geometry.mesh import Mesh

MOST_ERROR = 0.2  # over sqrt(area): where the colour scale ends, as in Lim et al. 2018
ERROR_COLORS = colormaps["magma_r"]  # lightness decreases monotonically: readable in greyscale
VALUE_COLORS = colormaps["viridis"]
GREY = 0.6  # each channel of a vertex without a counterpart


def template_colors(template: Mesh) -> np.ndarray:
    """Colours of the template's vertices, by position in the bounding box.

    Equal colours on two shapes mean the same point of the template.

    Returns:
        float64 [K, 3] in 0..1.
    """
    return point_colors(template, template.vertices)


def point_colors(template: Mesh, points: np.ndarray) -> np.ndarray:
    """Colours of points on the template, by position in its bounding box.

    Args:
        template: The template.
        points: float [V, 3] in the template's unit of length; NaN where there is none.

    Returns:
        float64 [V, 3] in 0..1; grey where points are NaN.
    """
    low, high = template.vertices.min(axis=0), template.vertices.max(axis=0)
    colors = 0.1 + 0.9 * (points - low) / np.maximum(high - low, 1e-12)
    return np.where(np.isnan(colors), GREY, colors.clip(0, 1))


def error_colors(errors: np.ndarray) -> np.ndarray:
    """Colours of geodesic errors: from light at 0 to dark at MOST_ERROR and above.

    Args:
        errors: float [V], over the square root of the area.

    Returns:
        float64 [V, 3] in 0..1.
    """
    return ERROR_COLORS(np.asarray(errors) / MOST_ERROR)[:, :3]


def confidence_colors(confidence: np.ndarray) -> np.ndarray:
    """Colours of confidences: from dark at 0 to light at 1.

    Args:
        confidence: float [V] in 0..1.

    Returns:
        float64 [V, 3] in 0..1.
    """
    return ERROR_COLORS(1 - np.asarray(confidence))[:, :3]


def value_colors(values: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Colours of any values, from the least to the largest value of a reference.

    One column is shown by a colour scale, two as red and green, more by the first three as red,
    green and blue.

    Args:
        values: Numbers or truth values, [V, ...].
        reference: [W, ...], of as many columns.

    Returns:
        float64 [V, 3] in 0..1; grey where a value is not finite.
    """
    columns, all_columns = (
        np.real(each).astype(np.float64).reshape(len(each), -1)[:, :3]
        for each in (values, reference)
    )
    finite = np.isfinite(all_columns)
    low = all_columns.min(axis=0, where=finite, initial=np.inf)
    high = all_columns.max(axis=0, where=finite, initial=-np.inf)
    with np.errstate(invalid="ignore"):
        shares = ((columns - low) / np.maximum(high - low, 1e-300)).clip(0, 1)
    known = np.isfinite(columns).all(axis=1)
    if shares.shape[1] == 1:
        shares = VALUE_COLORS(shares[:, 0])[:, :3]
    rest = np.zeros((len(shares), 3 - shares.shape[1]))
    return np.where(known[:, None], np.hstack([shares, rest]), GREY)
