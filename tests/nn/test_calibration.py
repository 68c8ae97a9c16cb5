"""The temperature by which scores were multiplied is found again."""

from __future__ import annotations

import pytest
import torch

from meshspiral.nn.calibration import fit_temperature


@pytest.mark.parametrize("temperature", [0.3, 1.0, 4.0])
def test_scores_that_are_off_by_a_factor(temperature):
    generator = torch.Generator().manual_seed(0)
    scores = 2 * torch.randn(20_000, 30, generator=generator, dtype=torch.float64)
    labels = torch.multinomial(scores.softmax(1), 1, generator=generator)[:, 0]
    assert fit_temperature(temperature * scores, labels) == pytest.approx(temperature, rel=0.03)
