"""The LSTM recurrence over spirals, as an autograd function with its own backward pass.

Each step writes gates, cells and a sigmoid of the cells into buffers for the backward pass; the
gradient of the gates then overwrites the gates. PyTorch's sigmoid is several times as fast as its
tanh, so tanh(x) is computed as 1 - 2 sigmoid(-2 x). All four gates then take one sigmoid, with the
factor -2 of the cell gate folded into the weights.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from meshspiral.nn.precision import add_product

# Sequences per chunk. With fewer, two threads wait for each other more often; with more, steps are
# slower as well.
ROWS = 1024
PARTS = 8  # chunks with `recompute`; so many for any mesh, so that memory is proportional to it
_sigmoid_backward = torch.ops.aten.sigmoid_backward.grad_input


def recurrence(
    projected: Tensor,
    weight: Tensor,
    spirals: Tensor,
    metric: Tensor | None = None,
    metric_weight: Tensor | None = None,
    recompute: bool = False,
) -> Tensor:
    """The hidden state of an LSTM at the last element of each sequence before padding.

    Gates are in the order input, forget, cell, output. Products are computed in the dtype of
    `projected`, states in that of `weight`. `metric` gets no gradient.

    Args:
        projected: Contribution of each vertex to the gates, biases included, float [V, 4 H].
        weight: Recurrent weight, float [4 H, H].
        spirals: Vertex indices of R sequences, int64 [R, N], padded with -1; the first column has
            no padding.
        metric: Metric features, float [R, N, M].
        metric_weight: Weight of the metric features, float [4 H, M]; required with `metric`.
        recompute: Whether the backward pass runs the forward steps again, an eighth of the
            sequences at a time, instead of keeping what all of them computed.

    Returns:
        float [R, H].

    Raises:
        RuntimeError: In a second backward pass, since the first one frees the buffers.
    """
    return _Recurrence.apply(projected, weight, metric_weight, spirals, metric, recompute)


class _Recurrence(torch.autograd.Function):
    """The recurrence in chunks of sequences."""

    @staticmethod
    def forward(ctx, projected, weight, metric_weight, spirals, metric, recompute):
        scales = _gate_scales(weight.shape[1], -2.0, weight)
        inputs = projected.to(weight.dtype) * scales
        recurrent = (weight.T * scales).to(projected.dtype)
        metric_map = None if metric is None else metric_weight.T * scales
        out = weight.new_empty(len(spirals), weight.shape[1])
        needed = any(ctx.needs_input_grad)

        def run(rows: slice, last: Tensor, save: bool) -> _Buffers:
            extra = None if metric is None else metric[rows].to(weight.dtype)
            return _forward_steps(inputs, recurrent, metric_map, spirals[rows], extra, last, save)

        size = math.ceil(len(spirals) / PARTS) if recompute else ROWS
        ctx.chunks = []
        for start in range(0, len(spirals), size):
            rows = slice(start, start + size)
            buffers = run(rows, out[rows], needed and not recompute)
            if needed:
                ctx.chunks.append((rows, None if recompute else buffers))
        ctx.run = run if recompute else None
        ctx.save_for_backward(weight, metric_weight)
        ctx.vertices, ctx.product_dtype = len(projected), projected.dtype
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        if ctx.chunks is None:
            raise RuntimeError(
                "backward of an LSTM layer can run only once per forward pass; "
                "run the forward pass again"
            )
        weight, metric_weight = ctx.saved_tensors
        # d tanh(x) / dx = 4 s (1 - s) with s = sigmoid(-2 x); sigmoid_backward gives s (1 - s)
        scales = _gate_scales(weight.shape[1], 4.0, weight)
        recurrent = (weight * scales[:, None]).to(ctx.product_dtype)
        grad = grad.to(weight.dtype)

        d_projected = weight.new_zeros(ctx.vertices, len(weight))
        d_weight = torch.zeros_like(weight)
        d_metric = None if metric_weight is None else torch.zeros_like(metric_weight)
        chunks, ctx.chunks = ctx.chunks, None
        while chunks:  # pop, so that the buffers of each chunk are freed after its use
            rows, buffers = chunks.pop()
            if buffers is None:
                buffers = ctx.run(rows, torch.empty_like(grad[rows]), True)
            _backward_steps(buffers, grad[rows], recurrent, d_projected, d_weight, d_metric)
        d_projected *= scales
        d_weight *= scales[:, None]
        if d_metric is not None:
            d_metric *= scales[:, None]
        return d_projected.to(ctx.product_dtype), d_weight, d_metric, None, None, None


class _Buffers(NamedTuple):
    """What the N forward steps of R sequences save for the backward pass.

    Attributes:
        indices: Vertex indices with 0 at padding, int64 [N, R].
        padding: Whether an element is padding, bool [N, R, 1].
        has_padding: For each step, whether any sequence has padding there; N entries.
        metric: Metric features, float [R, N, M], or None.
        gates: Activations of the gates, float [N, R, 4 H].
        cells: Cell states c, float [N, R, H].
        squashed: s = sigmoid(-2 c), float [N, R, H]. The hidden state is o (1 - 2 s), except at
            padding.
    """

    indices: Tensor
    padding: Tensor
    has_padding: list[bool]
    metric: Tensor | None
    gates: Tensor
    cells: Tensor
    squashed: Tensor


def _forward_steps(
    inputs: Tensor,
    recurrent: Tensor,
    metric_map: Tensor | None,
    spirals: Tensor,
    metric: Tensor | None,
    out: Tensor,
    save: bool,
) -> _Buffers:
    """Run the LSTM over R sequences and write their last hidden states into `out`.

    Args:
        inputs: Scaled contribution of each vertex to the gates, float [V, 4 H].
        recurrent: Scaled recurrent weight, transposed, float [H, 4 H].
        metric_map: Scaled weight of the metric features, transposed, float [M, 4 H].
        spirals: int64 [R, N].
        metric: float [R, N, M].
        out: Result, float [R, H].
        save: Whether to save all steps; if not, two slots are reused in turn.
    """
    (rows, length), width = spirals.shape, recurrent.shape[0]
    slots = length if save else 2
    gates = inputs.new_empty(slots, rows, 4 * width)
    cells, squashed = inputs.new_empty(2, slots, rows, width)
    hidden = inputs.new_empty(2, rows, width)
    indices, padding = spirals.clamp(min=0).T.contiguous(), (spirals < 0).T[..., None]
    has_padding = padding.any(dim=1).flatten().tolist()
    gate, cell, squash = gates.unbind(), cells.unbind(), squashed.unbind()
    i, f, g, o = _split_gates(gates)
    for step in range(length):
        now, before = step % slots, (step - 1) % slots
        state, last_state = hidden[step % 2], hidden[(step - 1) % 2]
        torch.index_select(inputs, 0, indices[step], out=gate[now])
        if metric is not None:
            gate[now].addmm_(metric[:, step], metric_map)
        if step > 0:
            add_product(gate[now], last_state.to(recurrent.dtype), recurrent)
        gate[now].sigmoid_()
        torch.addcmul(i[now], i[now], g[now], value=-2, out=cell[now])  # i tanh = i (1 - 2 g)
        if step > 0:
            cell[now].addcmul_(f[now], cell[before])
        torch.mul(cell[now], -2, out=squash[now]).sigmoid_()
        torch.addcmul(o[now], o[now], squash[now], value=-2, out=state)  # o tanh(c)
        if has_padding[step]:
            # padding leaves cell and hidden state unchanged
            torch.where(padding[step], cell[before], cell[now], out=cell[now])
            torch.where(padding[step], last_state, state, out=state)
    out.copy_(state)
    return _Buffers(indices, padding, has_padding, metric, gates, cells, squashed)


def _backward_steps(
    buffers: _Buffers,
    grad: Tensor,
    recurrent: Tensor,
    d_projected: Tensor,
    d_weight: Tensor,
    d_metric: Tensor | None,
) -> None:
    """Add the gradients of R sequences, not yet scaled for the cell gate.

    Args:
        buffers: Of the forward steps; `gates` is overwritten by its gradient, and `squashed` by
            the hidden states.
        grad: Gradient of the last hidden states, float [R, H].
        recurrent: Scaled recurrent weight, float [4 H, H].
        d_projected: Gradient to add to, float [V, 4 H].
        d_weight: Gradient to add to, float [4 H, H].
        d_metric: Gradient to add to, float [4 H, M].
    """
    indices, padding, has_padding, metric, gates, cells, squashed = buffers
    dtype, width = recurrent.dtype, recurrent.shape[1]
    d_hidden, d_cell = grad.clone(), torch.zeros_like(grad)
    scratch = torch.empty_like(grad)
    gates_low = gates if dtype == gates.dtype else torch.empty_like(gates, dtype=dtype)
    d_gate = torch.empty_like(gates[0])
    d_i, d_f, d_g, d_o = d_gate.split(width, dim=1)
    gate, cell, squash = gates.unbind(), cells.unbind(), squashed.unbind()
    i, f, g, o = _split_gates(gates)
    for step in reversed(range(len(gate))):
        passed = (d_hidden.clone(), d_cell.clone()) if has_padding[step] else None
        torch.addcmul(d_hidden, d_hidden, squash[step], value=-2, out=d_o)
        torch.mul(d_hidden, o[step], out=scratch)
        d_cell.add_(_sigmoid_backward(scratch, squash[step], grad_input=scratch), alpha=4)
        # now the hidden state, for d_weight; wrong at padding, where later gates have no gradient
        torch.addcmul(o[step], o[step], squash[step], value=-2, out=squash[step])
        torch.addcmul(d_cell, d_cell, g[step], value=-2, out=d_i)
        torch.mul(d_cell, i[step], out=d_g)
        if step > 0:
            torch.mul(d_cell, cell[step - 1], out=d_f)
            d_cell *= f[step]
        else:
            d_f.zero_()
        _sigmoid_backward(d_gate, gate[step], grad_input=gate[step])
        if passed:
            gate[step].masked_fill_(padding[step], 0.0)
        if step > 0:
            d_hidden = (gates_low[step].copy_(gate[step]) @ recurrent).to(grad.dtype)
        if passed:  # at padding, the gradient passes through unchanged
            d_hidden += passed[0] * padding[step]
            torch.where(padding[step], passed[1], d_cell, out=d_cell)
    flat = gates.flatten(0, 1)
    d_projected.index_add_(0, indices.view(-1), flat)
    states = squashed[:-1].flatten(0, 1).to(dtype)
    add_product(d_weight, gates_low[1:].flatten(0, 1).T, states)
    if metric is not None:
        d_metric.addmm_(flat.T, metric.transpose(0, 1).flatten(0, 1))


def _split_gates(gates: Tensor) -> list[tuple[Tensor, ...]]:
    """For each of the four gates, a tuple with its [R, H] view of every step of `gates`."""
    return [gate.unbind() for gate in gates.chunk(4, dim=2)]


def _gate_scales(width: int, scale: float, like: Tensor) -> Tensor:
    """float [4 width]: `scale` for the cell gate, which is the third, and 1 for the others."""
    scales = like.new_ones(4, width)
    scales[2] = scale
    return scales.view(-1)
