"""Layers that read a vertex's neighbourhood as a sequence: the spiral of `meshspiral.geometry.spirals`.

Both take features [V, C] and spirals [V, N] of vertex indices, -1 where a sequence has ended, and
optionally metric information [V, N, 2] (see `metric_features`); both give [V, out_features].
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from meshspiral.nn.precision import add_product, product_dtype
from meshspiral.nn.recurrence import recurrence

METRIC_FEATURES = 2  # distance and angle
# The forget gate's first bias. Of the centre, which is read first, sigmoid(3)^20, two fifths, are
# there at the end of 20 elements; with the usual 1 it is a 500th, and hardly anything is learnt.
REMEMBER = 3.0
ROWS = 2048  # sequences gathered at a time: fewer took a twentieth more time, more only more memory


def metric_features(vertices: Tensor, spirals: Tensor, unit: Tensor | float) -> Tensor:
    """The metric information of Lim et al. 2018 ("++"): distance and angle of each element.

    For element c of the spiral around a, with b the element before it: |c - a| / unit, and the
    angle at a between b and c in radians. The angle of the centre and of the first neighbour is 0,
    and so is everything where the sequence has ended.

    vertices: float [V, 3]. spirals: int64 [V, N]. unit: the length to divide by, in the vertices'
    unit; it should follow the shape's size and not its tessellation. Returns float [V, N, 2].
    """
    ended = spirals < 0
    points = F.embedding(spirals.clamp(min=0), vertices)
    rays = points - points[:, :1]
    lengths = rays.norm(dim=2)
    angles = torch.zeros_like(lengths)
    before, here = rays[:, 1:-1], rays[:, 2:]
    # atan2 of the sine and the cosine stays exact where acos loses half its digits
    angles[:, 2:] = torch.atan2(
        torch.linalg.cross(before, here).norm(dim=2), (before * here).sum(dim=2)
    )
    features = torch.stack([lengths / unit, angles], dim=2)
    return features.masked_fill_(ended[..., None], 0.0)


class SpiralLinear(nn.Module):
    """One linear map of the whole sequence of fixed length (the FCS layer of Lim et al. 2018).

    out_features * (length * (in_features + 2 if metric)) weights and out_features biases.
    """

    def __init__(self, in_features: int, out_features: int, length: int, metric: bool = False):
        super().__init__()
        self.length = length
        self.linear = nn.Linear(length * in_features, out_features)
        self.metric = (
            nn.Linear(length * METRIC_FEATURES, out_features, bias=False) if metric else None
        )
        fan_in = length * (in_features + METRIC_FEATURES * metric)
        for layer in filter(None, (self.linear, self.metric)):
            glorot(layer.weight, fan_in, out_features)
        nn.init.zeros_(self.linear.bias)

    def forward(self, features: Tensor, spirals: Tensor, metric: Tensor | None = None) -> Tensor:
        if spirals.shape[1] != self.length:
            raise ValueError(f"spirals must have length {self.length}, got {spirals.shape[1]}")
        out = _SpiralProduct.apply(features, self.linear.weight, self.linear.bias, spirals)
        return out if self.metric is None else out + self.metric(metric.flatten(1))


class _SpiralProduct(torch.autograd.Function):
    """features[spirals] weight^T + bias, with zeros where a spiral has ended.

    The sequences, N times as large as the features, only ever exist for ROWS vertices: backwards
    they are gathered once more, which costs less than to keep them.
    """

    @staticmethod
    def forward(ctx, features, weight, bias, spirals):
        product = product_dtype(weight)
        last = len(features)
        features = torch.cat([features, features.new_zeros(1, features.shape[1])]).to(product)
        weight, bias = weight.to(product), bias.to(product)
        elements = spirals.where(spirals >= 0, last)
        out = features.new_empty(len(spirals), len(weight))
        for start in range(0, len(spirals), ROWS):
            rows = slice(start, start + ROWS)
            sequences = features.index_select(0, elements[rows].reshape(-1))
            torch.addmm(bias, sequences.view(-1, weight.shape[1]), weight.T, out=out[rows])
        ctx.save_for_backward(features, weight, elements)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        features, weight, elements = ctx.saved_tensors
        total = torch.promote_types(weight.dtype, torch.float32)  # of sums over vertices
        d_features = torch.zeros_like(features, dtype=total)
        d_weight = torch.zeros_like(weight, dtype=total)
        for start in range(0, len(elements), ROWS):
            rows = slice(start, start + ROWS)
            flat = elements[rows].reshape(-1)
            sequences = features.index_select(0, flat).view(-1, weight.shape[1])
            add_product(d_weight, grad[rows].T, sequences)
            torch.mm(grad[rows], weight, out=sequences)
            d_features.index_add_(0, flat, sequences.view(len(flat), -1).to(total))
        return d_features[:-1], d_weight, grad.sum(0, dtype=total), None


class SpiralLSTM(nn.Module):
    """An LSTM along the sequence; its output is the hidden state at the last real element.

    Sequences may differ in length (-1 from where one has ended; every one has an element).
    Gates in the order input, forget, cell, output, with one bias each:
    4 out_features (in_features + 2 if metric + out_features + 1) parameters.
    """

    def __init__(self, in_features: int, out_features: int, metric: bool = False):
        super().__init__()
        gates = 4 * out_features
        self.input = nn.Linear(in_features, gates)
        self.metric = nn.Linear(METRIC_FEATURES, gates, bias=False) if metric else None
        self.hidden = nn.Linear(out_features, gates, bias=False)
        for layer in filter(None, (self.input, self.metric)):  # each gate is a map of its own
            glorot(layer.weight, in_features + METRIC_FEATURES * metric, out_features)
        glorot(self.hidden.weight, out_features, out_features)
        nn.init.zeros_(self.input.bias)
        nn.init.constant_(self.input.bias[out_features : 2 * out_features], REMEMBER)

    def forward(self, features: Tensor, spirals: Tensor, metric: Tensor | None = None) -> Tensor:
        # The input's share of the gates depends on the element alone, not on the sequence it
        # stands in: V products serve all V N elements.
        if self.metric is None:
            return recurrence(self.input(features), self.hidden.weight, spirals)
        return recurrence(
            self.input(features), self.hidden.weight, spirals, metric, self.metric.weight
        )


def glorot(weight: Tensor, fan_in: int, fan_out: int) -> None:
    """Glorot and Bengio's (2010) uniform weights, for a block of a larger matrix too."""
    bound = (6.0 / (fan_in + fan_out)) ** 0.5
    nn.init.uniform_(weight, -bound, bound)


def dense(in_features: int, out_features: int) -> nn.Linear:
    """A fully connected layer, on each vertex alone, initialised like the others."""
    layer = nn.Linear(in_features, out_features)
    nn.init.xavier_uniform_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer
