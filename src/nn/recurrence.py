"""The LSTM's recurrence over spirals, with a gradient of its own.

Each step writes its gates, cells and hidden states into buffers, where the gradient finds them, and
the gates' gradient takes the gates' place.
"""

from __future__ import annotations

import torch
from torch import Tensor

from src.nn.precision import add_product

ROWS = 512  # sequences at a time: their states stay in the processor's cache
_sigmoid_backward = torch.ops.aten.sigmoid_backward.grad_input
_tanh_backward = torch.ops.aten.tanh_backward.grad_input


def recurrence(
    projected: Tensor,
    weight: Tensor,
    spirals: Tensor,
    metric: Tensor | None = None,
    metric_weight: Tensor | None = None,
) -> Tensor:
    """float [R, H]: the hidden state of each of R sequences at its last real element.

    projected: float [V, 4 H], the share of the gates (input, forget, cell, output) that each
    vertex has in them as an element, biases included. weight: float [4 H, H]. spirals: int64
    [R, N], -1 where one has ended; each has an element. metric: float [R, N, M], with
    metric_weight: float [4 H, M]. No gradient by `metric`. Products are in the dtype of
    `projected`, states in that of `weight`. Its gradient can be formed once.
    """
    parts = []
    for start in range(0, len(spirals), ROWS):
        rows = slice(start, start + ROWS)
        extra = None if metric is None else metric[rows]
        parts.append(_Recurrence.apply(projected, weight, metric_weight, spirals[rows], extra))
    return torch.cat(parts)


class _Recurrence(torch.autograd.Function):
    @staticmethod
    def forward(ctx, projected, weight, metric_weight, spirals, metric):
        (rows, length), width = spirals.shape, weight.shape[1]
        kept = length if any(ctx.needs_input_grad) else 2
        new = {"dtype": weight.dtype, "device": weight.device}
        gates = torch.empty(kept, rows, 4 * width, **new)
        cells, hidden = torch.empty(2, kept, rows, width, **new)
        elements, ended = spirals.clamp(min=0).T.contiguous(), (spirals < 0).T[..., None]
        ends = ended.any(dim=1).flatten().tolist()
        entering = projected.to(weight.dtype)
        product = projected.dtype
        recurrent = weight.T.to(product)
        for step in range(length):
            now, before = step % kept, (step - 1) % kept
            torch.index_select(entering, 0, elements[step], out=gates[now])
            if metric is not None:
                gates[now].addmm_(metric[:, step].to(weight.dtype), metric_weight.T)
            if step > 0:
                add_product(gates[now], hidden[before].to(product), recurrent)
            i, f, g, o = gates[now].split(width, dim=1)
            i.sigmoid_(), f.sigmoid_(), g.tanh_(), o.sigmoid_()
            torch.mul(i, g, out=cells[now])
            if step > 0:
                cells[now].addcmul_(f, cells[before])
            torch.tanh(cells[now], out=hidden[now]).mul_(o)
            if ends[step]:
                for state in (cells, hidden):
                    torch.where(ended[step], state[before], state[now], out=state[now])
        ctx.save_for_backward(weight, elements, metric, gates, cells, hidden, ended)
        ctx.ends, ctx.product, ctx.vertices = ends, product, len(projected)
        return hidden[(length - 1) % kept].clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        weight, elements, metric, gates, cells, hidden, ended = ctx.saved_tensors
        width, product = weight.shape[1], ctx.product
        recurrent = weight.to(product)
        d_hidden, d_cell = grad.to(weight.dtype, copy=True), torch.zeros_like(hidden[0])
        one, two, tanh = torch.empty(3, *d_cell.shape, dtype=weight.dtype, device=weight.device)
        for step in reversed(range(len(gates))):
            i, f, g, o = gates[step].split(width, dim=1)
            held = (d_hidden.clone(), d_cell.clone()) if ctx.ends[step] else None
            torch.tanh(cells[step], out=tanh)
            torch.mul(d_hidden, tanh, out=one), torch.mul(d_hidden, o, out=two)
            _sigmoid_backward(one, o, grad_input=o)
            d_cell += _tanh_backward(two, tanh, grad_input=two)
            torch.mul(d_cell, g, out=one), torch.mul(d_cell, i, out=two)
            _sigmoid_backward(one, i, grad_input=i)
            _tanh_backward(two, g, grad_input=g)
            if step > 0:
                torch.mul(d_cell, cells[step - 1], out=one)
                d_cell *= f
                _sigmoid_backward(one, f, grad_input=f)
            else:
                f.zero_()
            if held:
                gates[step].masked_fill_(ended[step], 0.0)
            if step > 0:
                d_hidden = (gates[step].to(product) @ recurrent).to(weight.dtype)
            if held:
                d_hidden += held[0] * ended[step]
                torch.where(ended[step], held[1], d_cell, out=d_cell)
        flat = gates.flatten(0, 1)
        d_projected = gates.new_zeros(ctx.vertices, 4 * width).index_add_(
            0, elements.view(-1), flat
        )
        later = gates[1:].flatten(0, 1).to(product)
        d_weight = (later.T @ hidden[:-1].flatten(0, 1).to(product)).to(weight.dtype)
        d_metric = None
        if metric is not None:
            d_metric = flat.T @ metric.transpose(0, 1).reshape(len(flat), -1).to(weight.dtype)
        return d_projected.to(product), d_weight, d_metric, None, None
