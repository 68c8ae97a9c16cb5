"""Softmax cross-entropy over a last linear layer, without ever holding all its scores."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from meshspiral.nn.precision import add_product, product_dtype

ROWS = 512  # scores of 512 vertices at a time stay in a processor's cache


def linear_cross_entropy(x: Tensor, weight: Tensor, bias: Tensor, labels: Tensor) -> Tensor:
    """mean over v of -log softmax(x[v] weight^T + bias)[labels[v]], as a scalar.

    x: float [V, C]. weight: float [K, C]. bias: float [K]. labels: int64 [V].
    The same as F.cross_entropy(F.linear(x, weight, bias), labels). Gradients are formed chunk by
    chunk while the scores are there, so memory is that of ROWS rows. Under autocast the products
    are in its dtype; the sums are in float32 all the same. Can't be differentiated twice.
    """
    return _LinearCrossEntropy.apply(x, weight, bias, labels)


class _LinearCrossEntropy(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, weight, bias, labels):
        device = x.device.type
        product = product_dtype(weight)
        x_low, weight_low = x.detach().to(product), weight.detach().to(product)
        total = torch.promote_types(product, torch.float32)  # of sums over rows
        grad_x = torch.empty_like(x_low)
        grad_weight = torch.zeros(weight.shape, dtype=total, device=weight.device)
        grad_bias = torch.zeros(bias.shape, dtype=total, device=bias.device)
        loss = torch.zeros((), dtype=total, device=x.device)
        wants_gradient = any(ctx.needs_input_grad)
        with torch.autocast(device, enabled=False):
            for start in range(0, len(x), ROWS):
                rows = slice(start, start + ROWS)
                label = labels[rows, None]
                scores = (x_low[rows] @ weight_low.T).to(total).add_(bias.detach())
                scores -= scores.amax(dim=1, keepdim=True)
                right = scores.gather(1, label)
                sums = scores.exp_().sum(dim=1, keepdim=True)
                loss += (sums.log() - right).sum()
                if not wants_gradient:
                    continue
                scores /= sums * len(x)  # now the gradient by the scores, but for the label's
                scores.scatter_add_(1, label, torch.full_like(right, -1.0 / len(x)))
                grad_bias += scores.sum(dim=0)
                grad = scores.to(product)
                torch.mm(grad, weight_low, out=grad_x[rows])
                add_product(grad_weight, grad.T, x_low[rows])
        ctx.save_for_backward(
            grad_x.to(x.dtype), grad_weight.to(weight.dtype), grad_bias.to(bias.dtype)
        )
        return loss / len(x)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        return (
            *(
                grad * g.to(grad.dtype) if g.dtype != grad.dtype else g * grad
                for g in ctx.saved_tensors
            ),
            None,
        )


class Prediction(NamedTuple):
    """classes int64 [V], of the largest score; probability float [V], the softmax of that score.
    With labels: of_label float [V], the softmax of theirs, and loss, as `linear_cross_entropy`
    gives it; else None."""

    classes: Tensor
    probability: Tensor
    of_label: Tensor | None
    loss: Tensor | None


@torch.no_grad()
def predict(x: Tensor, weight: Tensor, bias: Tensor, labels: Tensor | None = None) -> Prediction:
    """The class with the largest score x weight^T + bias. Arguments as above.

    Never in bf16: among its 8 bits many scores would tie, and the first class win.
    """
    classes = torch.empty(len(x), dtype=torch.int64, device=x.device)
    probability = torch.empty(len(x), dtype=weight.dtype, device=x.device)
    losses = None if labels is None else torch.empty_like(probability)
    with torch.autocast(x.device.type, enabled=False):
        for start in range(0, len(x), ROWS):
            rows = slice(start, start + ROWS)
            scores = torch.addmm(bias, x[rows].to(weight.dtype), weight.T)
            best = torch.argmax(scores, dim=1, keepdim=True)
            scores -= scores.gather(1, best)
            right = None if labels is None else scores.gather(1, labels[rows, None])
            sums = scores.exp_().sum(1, keepdim=True)
            if right is not None:
                losses[rows] = (sums.log() - right)[:, 0]
            classes[rows], probability[rows] = best[:, 0], 1 / sums[:, 0]
    if losses is None:
        return Prediction(classes, probability, None, None)
    return Prediction(classes, probability, (-losses).exp(), losses.mean())
