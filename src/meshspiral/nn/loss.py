"""Softmax cross-entropy over the last linear layer, chunk by chunk to save memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from meshspiral.nn.precision import add_product, product_dtype

ROWS = 512  # vertices per chunk; their scores fit in the processor's cache


class SoftLabels(NamedTuple):
    """A probability distribution over the K classes for every label.

    Attributes:
        classes: Its classes, int64 [K, M]; entries beyond a distribution's size are any class.
        weights: Their probabilities, float [K, M], with rows of sum 1; 0 beyond.
    """

    classes: Tensor
    weights: Tensor


class Points(NamedTuple):
    """Labels that lie between vertices: mixtures of three labels.

    Attributes:
        corners: The labels, int64 [V, 3].
        weights: Their shares, float [V, 3], with rows of sum 1.
    """

    corners: Tensor
    weights: Tensor


def linear_cross_entropy(
    x: Tensor,
    weight: Tensor,
    bias: Tensor,
    labels: Tensor | Points,
    soft: SoftLabels | None = None,
) -> Tensor:
    """Mean cross-entropy of a linear layer, without storing all its scores.

    Equals `F.cross_entropy(F.linear(x, weight, bias), labels)`; with soft labels, the labels are
    replaced by their distributions, float [V, K]. The gradients are computed in the
    forward pass, chunk by chunk, so scores take the memory of ROWS rows. Under autocast, products
    are computed in autocast's dtype and sums in float32. Not twice differentiable.

    Args:
        x: Inputs of the layer, float [V, C].
        weight: float [K, C].
        bias: float [K].
        labels: Class indices, int64 [V], or with `soft` also mixtures of three.
        soft: The distribution of every label; None for certainty.

    Returns:
        A scalar: the mean over v of -log softmax(x[v] weight^T + bias)[labels[v]], or with `soft`
        of the mean of this under the label's distribution.
    """
    return _LinearCrossEntropy.apply(x, weight, bias, labels, soft)


def _targets(
    labels: Tensor | Points, soft: SoftLabels | None, rows: slice, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """The classes and probabilities that some rows aim at, int64 [R, M] and float [R, M]."""
    if soft is None:
        label = labels[rows, None]
        return label, torch.ones_like(label, dtype=dtype)
    if isinstance(labels, Points):
        corners, shares = labels.corners[rows], labels.weights[rows, :, None].to(dtype)
        weights = soft.weights[corners].to(dtype) * shares
        return soft.classes[corners].flatten(1), weights.flatten(1)
    return soft.classes[labels[rows]], soft.weights[labels[rows]].to(dtype)


class _LinearCrossEntropy(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, weight, bias, labels, soft):
        device = x.device.type
        dtype = product_dtype(weight)
        x_low, weight_low = x.detach().to(dtype), weight.detach().to(dtype)
        sum_dtype = torch.promote_types(dtype, torch.float32)  # for sums over rows
        grad_x = torch.empty_like(x_low)
        grad_weight = torch.zeros(weight.shape, dtype=sum_dtype, device=weight.device)
        grad_bias = torch.zeros(bias.shape, dtype=sum_dtype, device=bias.device)
        loss = torch.zeros((), dtype=sum_dtype, device=x.device)
        needs_gradient = any(ctx.needs_input_grad)
        with torch.autocast(device, enabled=False):
            for start in range(0, len(x), ROWS):
                rows = slice(start, start + ROWS)
                classes, shares = _targets(labels, soft, rows, sum_dtype)
                scores = (x_low[rows] @ weight_low.T).to(sum_dtype).add_(bias.detach())
                scores -= scores.amax(dim=1, keepdim=True)
                label_score = (scores.gather(1, classes) * shares).sum(1, keepdim=True)
                sums = scores.exp_().sum(dim=1, keepdim=True)
                loss += (sums.log() - label_score).sum()
                if not needs_gradient:
                    continue
                scores /= sums * len(x)  # the gradient of the scores, except at the label
                scores.scatter_add_(1, classes, shares / -len(x))
                grad_bias += scores.sum(dim=0)
                grad = scores.to(dtype)
                torch.mm(grad, weight_low, out=grad_x[rows])
                add_product(grad_weight, grad.T, x_low[rows])
        ctx.save_for_backward(
            grad_x.to(x.dtype), grad_weight.to(weight.dtype), grad_bias.to(bias.dtype)
        )
        return loss / len(x)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        return *(grad * g.to(grad.dtype) for g in ctx.saved_tensors), None, None


class Prediction(NamedTuple):
    """The predicted class of each row and its softmax probability.

    Attributes:
        classes: Class with the largest score, int64 [V].
        probability: Softmax probability of that class, float [V].
        of_label: Softmax probability of the label, float [V]; None without labels.
        loss: Mean cross-entropy, as `linear_cross_entropy` returns it; None without labels.
    """

    classes: Tensor
    probability: Tensor
    of_label: Tensor | None
    loss: Tensor | None


@torch.no_grad()
def predict(
    x: Tensor | Sequence[Tensor], weight: Tensor, bias: Tensor, labels: Tensor | None = None
) -> Prediction:
    """Predict the class with the largest score x weight^T + bias, in chunks of ROWS rows.

    Scores are always in the dtype of `weight`, even under autocast: bf16 has 8 significant bits, so
    many scores would tie, and the tie would go to the lowest class.

    Args:
        x: Inputs of the layer, float [V, C]. Of several inputs, the mean of their log-probabilities
            takes the place of the scores.
        weight: float [K, C].
        bias: float [K].
        labels: Class indices, int64 [V], or None.

    Returns:
        The prediction; with labels, also their probabilities and the loss.
    """
    inputs = [x] if isinstance(x, Tensor) else list(x)
    x = inputs[0]
    classes = torch.empty(len(x), dtype=torch.int64, device=x.device)
    probability = torch.empty(len(x), dtype=weight.dtype, device=x.device)
    losses = None if labels is None else torch.empty_like(probability)
    with torch.autocast(x.device.type, enabled=False):
        for start in range(0, len(x), ROWS):
            rows = slice(start, start + ROWS)
            scores = torch.addmm(bias, x[rows].to(weight.dtype), weight.T)
            if len(inputs) > 1:
                scores = scores.log_softmax(dim=1)
                for other in inputs[1:]:
                    vote = torch.addmm(bias, other[rows].to(weight.dtype), weight.T)
                    scores += vote.log_softmax(dim=1)
                scores /= len(inputs)
            best = torch.argmax(scores, dim=1, keepdim=True)
            scores -= scores.gather(1, best)
            label_score = None if labels is None else scores.gather(1, labels[rows, None])
            sums = scores.exp_().sum(1, keepdim=True)
            if label_score is not None:
                losses[rows] = (sums.log() - label_score)[:, 0]
            classes[rows], probability[rows] = best[:, 0], 1 / sums[:, 0]
    if losses is None:
        return Prediction(classes, probability, None, None)
    return Prediction(classes, probability, (-losses).exp(), losses.mean())
