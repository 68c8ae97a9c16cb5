"""Temperature scaling (Guo, Pleiss, Sun, Weinberger, "On calibration of modern networks", 2017)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

MOST = 20.0  # temperatures are sought between 1 / MOST and MOST
STEPS = 16  # of bisection: to one part in 10,000


def fit_temperature(scores: Tensor, labels: Tensor) -> float:
    """The number by which scores are divided so that their softmax fits the labels best.

    It minimises the mean negative log-likelihood. The order of the scores does not change.

    Args:
        scores: float [N, K], of samples that were not trained on.
        labels: Their classes, int64 [N].

    Returns:
        The temperature, between 1 / MOST and MOST.
    """
    of_label = scores.gather(1, labels[:, None])[:, 0]
    low, high = -math.log(MOST), math.log(MOST)
    for _ in range(STEPS):
        middle = (low + high) / 2
        # the loss is convex in 1 / temperature, so its slope changes sign once
        expected = (torch.softmax(scores * math.exp(-middle), dim=1) * scores).sum(dim=1)
        if float((expected - of_label).mean()) > 0:  # too sure: warmer
            low = middle
        else:
            high = middle
    return math.exp((low + high) / 2)
