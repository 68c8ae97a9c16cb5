"""The LSTM's recurrence over spirals, with a gradient of its own.

Each step writes its gates, cells and hidden states into buffers, where the gradient finds them, and
the gates' gradient takes the gates' place. All four gates take one sigmoid: the cell gate is
tanh(x) = 1 - 2 sigmoid(-2 x), with the -2 in its weights.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from meshspiral.nn.precision import add_product

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
    return _Recurrence.apply(projected, weight, metric_weight, spirals, metric)


class _Recurrence(torch.autograd.Function):
    """ROWS sequences after the other."""

    @staticmethod
    def forward(ctx, projected, weight, metric_weight, spirals, metric):
        cell_gate = _scales(weight.shape[1], -2.0, weight)
        entering = projected.to(weight.dtype) * cell_gate
        recurrent = (weight.T * cell_gate).to(projected.dtype)
        by_metric = None if metric is None else metric_weight.T * cell_gate
        out, keep = weight.new_empty(len(spirals), weight.shape[1]), any(ctx.needs_input_grad)

        ctx.walks = []
        for start in range(0, len(spirals), ROWS):
            rows = slice(start, start + ROWS)
            extra = None if metric is None else metric[rows].to(weight.dtype)
            walked = _walk(entering, recurrent, by_metric, spirals[rows], extra, out[rows], keep)
            if keep:
                ctx.walks.append((rows, walked))
        ctx.save_for_backward(weight, metric_weight)
        ctx.vertices, ctx.product = len(projected), projected.dtype
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        if ctx.walks is None:
            raise RuntimeError("the gradient of a recurrence can be formed once")
        weight, metric_weight = ctx.saved_tensors
        cell_gate = _scales(weight.shape[1], 4.0, weight)  # of d sigmoid(-2 x), for that of tanh(x)
        recurrent = (weight * cell_gate[:, None]).to(ctx.product)
        grad = grad.to(weight.dtype)

        d_projected = weight.new_zeros(ctx.vertices, len(weight))
        d_weight = torch.zeros_like(weight)
        d_metric = None if metric_weight is None else torch.zeros_like(metric_weight)
        walks, ctx.walks = ctx.walks, None
        while walks:  # what a block kept is freed when it is done
            rows, walked = walks.pop()
            _walk_back(walked, grad[rows], recurrent, d_projected, d_weight, d_metric)
        d_projected *= cell_gate
        d_weight *= cell_gate[:, None]
        if d_metric is not None:
            d_metric *= cell_gate[:, None]
        return d_projected.to(ctx.product), d_weight, d_metric, None, None


class _Walk(NamedTuple):
    """What N steps of R sequences leave for their gradient: elements [N, R]; where they have ended
    [N, R, 1], and whether any has; metric [R, N, M]; and their states [N, R, ...]."""

    elements: Tensor
    ended: Tensor
    ends: list[bool]
    metric: Tensor | None
    gates: Tensor
    cells: Tensor
    hidden: Tensor


def _walk(
    entering: Tensor,
    recurrent: Tensor,
    by_metric: Tensor | None,
    spirals: Tensor,
    metric: Tensor | None,
    out: Tensor,
    keep: bool,
) -> _Walk:
    """Steps of LSTM; their last hidden states [R, H] go into `out`. If nothing need be kept, two
    steps' states are."""
    (rows, length), width = spirals.shape, recurrent.shape[0]
    kept = length if keep else 2
    gates = entering.new_empty(kept, rows, 4 * width)
    cells, hidden = entering.new_empty(2, kept, rows, width)
    elements, ended = spirals.clamp(min=0).T.contiguous(), (spirals < 0).T[..., None]
    ends = ended.any(dim=1).flatten().tolist()
    gate, cell, state = gates.unbind(), cells.unbind(), hidden.unbind()
    i, f, g, o = _of_steps(gates)
    for step in range(length):
        now, before = step % kept, (step - 1) % kept
        torch.index_select(entering, 0, elements[step], out=gate[now])
        if metric is not None:
            gate[now].addmm_(metric[:, step], by_metric)
        if step > 0:
            add_product(gate[now], state[before].to(recurrent.dtype), recurrent)
        gate[now].sigmoid_()
        torch.addcmul(i[now], i[now], g[now], value=-2, out=cell[now])
        if step > 0:
            cell[now].addcmul_(f[now], cell[before])
        torch.tanh(cell[now], out=state[now]).mul_(o[now])
        if ends[step]:
            for each in (cell, state):
                torch.where(ended[step], each[before], each[now], out=each[now])
    out.copy_(state[now])
    return _Walk(elements, ended, ends, metric, gates, cells, hidden)


def _walk_back(
    walked: _Walk,
    grad: Tensor,
    recurrent: Tensor,
    d_projected: Tensor,
    d_weight: Tensor,
    d_metric: Tensor | None,
) -> None:
    """Adds to the gradients what one by `out`, [R, H], makes of them, but for the cell gate's
    scale. The gates are lost."""
    elements, ended, ends, metric, gates, cells, hidden = walked
    product, width = recurrent.dtype, recurrent.shape[1]
    d_hidden, d_cell = grad.clone(), torch.zeros_like(grad)
    one, tanh, d_gate = torch.empty_like(grad), torch.empty_like(grad), torch.empty_like(gates[0])
    d_i, d_f, d_g, d_o = d_gate.split(width, dim=1)
    gate, cell = gates.unbind(), cells.unbind()
    i, f, g, o = _of_steps(gates)
    for step in reversed(range(len(gate))):
        held = (d_hidden.clone(), d_cell.clone()) if ends[step] else None
        torch.tanh(cell[step], out=tanh)
        torch.mul(d_hidden, tanh, out=d_o), torch.mul(d_hidden, o[step], out=one)
        d_cell += _tanh_backward(one, tanh, grad_input=one)
        torch.addcmul(d_cell, d_cell, g[step], value=-2, out=d_i)
        torch.mul(d_cell, i[step], out=d_g)
        if step > 0:
            torch.mul(d_cell, cell[step - 1], out=d_f)
            d_cell *= f[step]
        else:
            d_f.zero_()
        _sigmoid_backward(d_gate, gate[step], grad_input=gate[step])
        if held:
            gate[step].masked_fill_(ended[step], 0.0)
        if step > 0:
            d_hidden = (gate[step].to(product) @ recurrent).to(grad.dtype)
        if held:
            d_hidden += held[0] * ended[step]
            torch.where(ended[step], held[1], d_cell, out=d_cell)
    flat = gates.flatten(0, 1)
    d_projected.index_add_(0, elements.view(-1), flat)
    later, states = gates[1:].flatten(0, 1), hidden[:-1].flatten(0, 1)
    add_product(d_weight, later.to(product).T, states.to(product))
    if metric is not None:
        d_metric.addmm_(flat.T, metric.transpose(0, 1).flatten(0, 1))


def _of_steps(gates: Tensor) -> list[tuple[Tensor, ...]]:
    """Of [N, R, 4 H]: for each of the four gates its [R, H] in every step."""
    return [gate.unbind() for gate in gates.chunk(4, dim=2)]


def _scales(width: int, scale: float, like: Tensor) -> Tensor:
    """[4 width]: scale in the place of the cell gate, the third, and 1 elsewhere."""
    scales = like.new_ones(4, width)
    scales[2] = scale
    return scales.view(-1)
