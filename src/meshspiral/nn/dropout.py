"""Dropout with few random bits."""

from __future__ import annotations

import torch
from torch import Tensor, nn

LEVELS = 2**16


class Dropout(nn.Dropout):
    """`torch.nn.Dropout`, whose probability is rounded to 16 bits on the processor.

    There, PyTorch draws 64 bits for each entry, in one thread. Here four entries share them.
    """

    def forward(self, x: Tensor) -> Tensor:
        if not (self.training and self.p and x.device.type == "cpu"):
            return super().forward(x)
        dropped = min(round(LEVELS * self.p), LEVELS - 1)
        count = x.numel()
        bits = torch.empty(-(-count // 4), dtype=torch.int64).random_(-(2**63), None)
        drawn = bits.view(torch.int16)[:count].view(x.shape)
        kept = (drawn >= dropped - LEVELS // 2).to(x.dtype)
        return x * kept.mul_(LEVELS / (LEVELS - dropped))
