"""Transfer of values along a map."""

from __future__ import annotations

import numpy as np


def transfer(values: np.ndarray, match: np.ndarray, missing: float) -> np.ndarray:
    """The values of the counterparts of all source vertices.

    Args:
        values: [W, ...], one row per target vertex.
        match: int [V], the target vertex of every source vertex, -1 for none.
        missing: The value of source vertices without a counterpart.

    Returns:
        [V, ...], with the dtype of `values`.
    """
    transferred = values[match]
    transferred[match < 0] = missing
    return transferred
