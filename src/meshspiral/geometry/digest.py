"""Hashes of arrays and values: equal content has an equal hash."""

from __future__ import annotations

import hashlib

import numpy as np


def digest(*parts: np.ndarray | str | float | None) -> str:
    """Hexadecimal SHA-256 of arrays (dtype, shape and content) and plain values, in their order."""
    sha = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            sha.update(f"|{part.dtype.str}{part.shape}|".encode())
            sha.update(np.ascontiguousarray(part).data)
        else:
            sha.update(f"|{part!r}|".encode())
    return sha.hexdigest()


def derived_seed(*parts: np.ndarray | int | str) -> int:
    """A seed below 2**60 for one purpose: equal parts give equal seeds."""
    return int(digest(*parts)[:15], 16)
