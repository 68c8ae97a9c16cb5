"""Temperature scaling (Guo, Pleiss, Sun, Weinberger, "On calibration of modern networks", 2017)."""

from __future__ import annotations

import math

import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

MOST = 20.0  # temperatures are sought between 1 / MOST and MOST


def fit_temperature(scores: Tensor, labels: Tensor) -> float:
    """The number by which scores are divided so that their softmax fits the labels best.

    It minimises the mean negative log-likelihood. The order of the scores does not change.

    Args:
        scores: float [N, K], of samples that were not trained on.
        labels: Their classes, int64 [N].
    """
    of_label = scores.gather(1, labels[:, None])[:, 0]

    def loss(log_temperature: float) -> float:
        factor = math.exp(-log_temperature)
        return float((torch.logsumexp(scores * factor, dim=1) - of_label * factor).mean())

    bounds = (-math.log(MOST), math.log(MOST))
    return math.exp(minimize_scalar(loss, bounds=bounds, method="bounded").x)
