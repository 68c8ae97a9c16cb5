"""The chunked last layer equals `F.linear` followed by `F.cross_entropy`."""

import pytest
import torch
from torch.nn import functional as F

from meshspiral.nn import loss as module
from meshspiral.nn.loss import Points, SoftLabels, linear_cross_entropy, predict


@pytest.fixture
def layer():
    torch.manual_seed(0)
    x, weight, bias = (
        torch.randn(*shape, dtype=torch.float64, requires_grad=True)
        for shape in ((23, 5), (17, 5), (17,))
    )
    return x, weight, bias, torch.randint(0, 17, (23,))


@pytest.mark.parametrize("rows", [1, 7, 23, 512])
def test_value_and_gradients_equal_those_of_linear_and_cross_entropy(layer, rows, monkeypatch):
    monkeypatch.setattr(module, "ROWS", rows)
    x, weight, bias, labels = layer
    loss = linear_cross_entropy(*layer)
    reference = F.cross_entropy(F.linear(x, weight, bias), labels)
    torch.testing.assert_close(loss, reference, rtol=0, atol=1e-12)
    for a, b in zip(
        torch.autograd.grad(3 * loss, (x, weight, bias)),
        torch.autograd.grad(3 * reference, (x, weight, bias)),
        strict=True,
    ):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-12)


def test_gradients_equal_finite_differences(layer):
    x, weight, bias, labels = layer
    assert torch.autograd.gradcheck(lambda *a: linear_cross_entropy(*a, labels), (x, weight, bias))


def test_very_large_scores_do_not_overflow(layer):
    x, weight, bias, labels = layer
    loss = linear_cross_entropy((1e4 * x).float(), weight.float(), bias.float(), labels)
    reference = F.cross_entropy(F.linear(1e4 * x, weight, bias), labels)
    torch.testing.assert_close(loss.double(), reference, rtol=1e-5, atol=0)


def test_autocast_multiplies_in_bf16_and_sums_in_float32(layer):
    x, weight, bias, labels = (t.detach().float() if t.is_floating_point() else t for t in layer)
    x.requires_grad_(), weight.requires_grad_()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss = linear_cross_entropy(x, weight, bias, labels)
    reference = F.cross_entropy(F.linear(x, weight, bias), labels)
    assert loss.dtype == torch.float32
    torch.testing.assert_close(loss, reference, rtol=2e-2, atol=0)
    assert loss != reference
    for a, b in zip(
        torch.autograd.grad(loss, (x, weight)),
        torch.autograd.grad(reference, (x, weight)),
        strict=True,
    ):
        assert a.dtype == torch.float32
        torch.testing.assert_close(a, b, rtol=0, atol=2e-2)


def test_without_gradients_the_value_is_the_same(layer):
    with torch.no_grad():
        torch.testing.assert_close(
            linear_cross_entropy(*layer), F.cross_entropy(F.linear(*layer[:3]), layer[3])
        )


@pytest.mark.parametrize("rows", [4, 512])
def test_predict_is_the_argmax_and_the_loss(layer, rows, monkeypatch):
    monkeypatch.setattr(module, "ROWS", rows)
    x, weight, bias, labels = layer
    classes, probability, of_label, loss = predict(*layer)
    scores = F.linear(x, weight, bias)
    torch.testing.assert_close(classes, scores.argmax(1))
    torch.testing.assert_close(probability, scores.softmax(1).amax(1), rtol=0, atol=1e-12)
    label_probability = scores.softmax(1).gather(1, labels[:, None])[:, 0]
    torch.testing.assert_close(of_label, label_probability, rtol=0, atol=1e-12)
    assert predict(*layer[:3]).loss is None and predict(*layer[:3]).of_label is None
    torch.testing.assert_close(loss, F.cross_entropy(scores, labels), rtol=0, atol=1e-12)


@pytest.fixture
def soft():
    """Distributions over up to four classes, the last entries of some unused."""
    generator = torch.Generator().manual_seed(1)
    classes = torch.randint(0, 17, (17, 4), generator=generator)
    classes[:, 0] = torch.arange(17)
    weights = torch.rand(17, 4, generator=generator, dtype=torch.float64)
    weights[::3, 2:] = 0.0
    return SoftLabels(classes, weights / weights.sum(1, keepdim=True))


def distributions(soft: SoftLabels) -> torch.Tensor:
    """float [K, K], the rows written out."""
    full = torch.zeros(17, 17, dtype=torch.float64)
    return full.scatter_add_(1, soft.classes, soft.weights)


@pytest.mark.parametrize("rows", [7, 512])
@pytest.mark.parametrize("between", [False, True])
def test_soft_labels_equal_cross_entropy_of_distributions(layer, soft, rows, between, monkeypatch):
    monkeypatch.setattr(module, "ROWS", rows)
    x, weight, bias, labels = layer
    targets = distributions(soft)[labels]
    if between:
        corners = torch.randint(0, 17, (23, 3))
        shares = torch.rand(23, 3, dtype=torch.float64)
        shares /= shares.sum(1, keepdim=True)
        labels = Points(corners, shares)
        targets = (distributions(soft)[corners] * shares[..., None]).sum(1)
    loss = linear_cross_entropy(x, weight, bias, labels, soft)
    reference = F.cross_entropy(F.linear(x, weight, bias), targets)
    torch.testing.assert_close(loss, reference, rtol=0, atol=1e-12)
    for a, b in zip(
        torch.autograd.grad(loss, (x, weight, bias)),
        torch.autograd.grad(reference, (x, weight, bias)),
        strict=True,
    ):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-9)


def test_votes_are_the_mean_of_log_probabilities(layer):
    x, weight, bias, labels = layer
    inputs = [x, torch.roll(x, 1, 0), x * 0.3]
    found = predict(inputs, weight, bias, labels)
    votes = torch.stack([F.linear(each, weight, bias).log_softmax(1) for each in inputs])
    expected = votes.mean(0).softmax(1)
    torch.testing.assert_close(found.probability, expected.max(1).values)
    assert torch.equal(found.classes, expected.argmax(1))
    torch.testing.assert_close(found.of_label, expected.gather(1, labels[:, None])[:, 0])
