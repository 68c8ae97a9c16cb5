"""Dropout: how much is dropped, and that it depends on the generator alone."""

import pytest
import torch

from meshspiral.nn.dropout import Dropout


@pytest.mark.parametrize("p", [0.3, 0.5, 0.001, 1 - 1e-9])
def test_the_probability_and_the_mean(p):
    torch.manual_seed(0)
    x = torch.ones(1000, 1001, dtype=torch.float64)
    dropped = Dropout(p)(x)
    share = round(2**16 * min(p, 1 - 2**-16)) / 2**16
    assert dropped.unique().tolist() == pytest.approx([0, 1 / (1 - share)])
    spread = (share * (1 - share) / x.numel()) ** 0.5
    assert (dropped == 0).double().mean() == pytest.approx(share, abs=4 * spread)
    columns = (dropped == 0).double().mean(0)  # no pattern of the four entries of a draw
    assert columns.std() == pytest.approx((share * (1 - share) / 1000) ** 0.5, rel=0.15)


@pytest.mark.parametrize("shape", [(7, 3), (1,), (5, 2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_gradient_passes_where_the_input_does(shape, dtype):
    torch.manual_seed(1)
    x = torch.rand(shape).add(1).to(dtype).requires_grad_()
    out = Dropout(0.4)(x)
    assert out.shape == x.shape and out.dtype == dtype
    out.sum().backward()
    torch.testing.assert_close(x.grad * x, out)


def test_the_seed_decides():
    drops = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        drops.append(Dropout(0.5)(torch.ones(100)))
    assert torch.equal(drops[0], drops[1]) and not torch.equal(drops[0], drops[2])


def test_nothing_is_dropped_in_evaluation_or_with_probability_zero():
    x = torch.rand(10, 3)
    assert torch.equal(Dropout(0.5).eval()(x), x) and torch.equal(Dropout(0.0)(x), x)
