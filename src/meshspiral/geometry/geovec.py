"""Geometry vectors (Litman, Bronstein 2014), the descriptors of the original GCNN3."""

from __future__ import annotations

import numpy as np

from meshspiral.geometry.laplacian import Spectrum


def geometry_vectors(spectrum: Spectrum, channels: int, largest: float) -> np.ndarray:
    """The energy of a vertex in overlapping bands of the Laplacian's spectrum.

    Channel q of vertex x is the sum over eigenfunctions f, with eigenvalues v, of
    B((v - q d) / d) f(x)^2, where d = largest / (channels - 1) and B is `cubic_spline`. Litman and
    Bronstein learn filters on top of these; Masci et al. 2015 use the vectors as they are. B begins
    at 0, so the constant function, of eigenvalue 0, has no part; the channels' weights sum to 1/6
    at eigenvalue d, 5/6 at 2 d, and 1 from 3 d up to `largest`.

    Args:
        spectrum: Of the surface. It should reach `largest`.
        channels: Number of channels Q, at least 2.
        largest: The eigenvalue where the last band begins, in the unit of the spectrum's.

    Returns:
        float64 [V, Q], each row divided by its L2 norm; NaN where all energies are 0.
    """
    step = largest / (channels - 1)
    bands = cubic_spline(spectrum.values[:, None] / step - np.arange(channels))
    energies = spectrum.functions**2 @ bands
    with np.errstate(invalid="ignore", divide="ignore"):
        return energies / np.linalg.norm(energies, axis=1, keepdims=True)


def cubic_spline(x: np.ndarray) -> np.ndarray:
    """The cubic B-spline on the knots 0, 1, 2, 3, 4; 0 elsewhere. Its integral is 1."""
    piece = np.floor(x)
    t = x - piece
    pieces = (
        t**3 / 6,
        (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6,
        (3 * t**3 - 6 * t**2 + 4) / 6,
        (-(t**3) + 3 * t**2 - 3 * t + 1) / 6,
    )
    return np.select([piece == i for i in range(4)], pieces, 0.0)
