"""Products in the dtype of autocast, sums in a wider one: what layers with a gradient of their own
must see to themselves."""

from __future__ import annotations

import torch
from torch import Tensor


def product_dtype(weight: Tensor) -> torch.dtype:
    """What products with a weight are computed in: autocast's dtype where it is on."""
    device = weight.device.type
    return torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else weight.dtype


def add_product(total: Tensor, a: Tensor, b: Tensor) -> None:
    """total += a b, in one pass where the dtypes allow it."""
    if a.dtype == total.dtype:
        total.addmm_(a, b)
    else:
        total += a @ b
