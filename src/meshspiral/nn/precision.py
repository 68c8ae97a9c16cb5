"""Mixed precision for layers with their own gradient: products in autocast's dtype, wider sums."""

from __future__ import annotations

import torch
from torch import Tensor


def product_dtype(weight: Tensor) -> torch.dtype:
    """The dtype for products with a weight.

    Args:
        weight: The layer's weight, on any device.

    Returns:
        Autocast's dtype for the weight's device if autocast is enabled, else the weight's dtype.
    """
    device = weight.device.type
    return torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else weight.dtype


def add_product(total: Tensor, a: Tensor, b: Tensor) -> None:
    """Add the matrix product a b to `total` in place, in one pass if the dtypes are equal.

    Args:
        total: float [M, N].
        a: float [M, K], in the dtype of `total` or a narrower one.
        b: float [K, N], in the dtype of `a`.
    """
    if a.dtype == total.dtype:
        total.addmm_(a, b)
    else:
        total += a @ b
