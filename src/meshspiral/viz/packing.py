"""Arrays inside pages."""

from __future__ import annotations

import base64

import numpy as np


def pack_array(array: np.ndarray, dtype: type) -> str:
    """The entries of an array row by row, little-endian, in base64."""
    little = np.ascontiguousarray(array, dtype=np.dtype(dtype).newbyteorder("<"))
    return base64.b64encode(little.tobytes()).decode()
