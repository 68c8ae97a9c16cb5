"""Spiral layers: the neighbourhood of a vertex as a sequence of vertices.

Both layers take features [V, in_features] and spirals [V, N] (see `meshspiral.geometry.spirals`),
optionally metric features [V, N, 2] (see `metric_features`), and return [V, out_features]. Spirals
hold vertex indices and are padded with -1.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from meshspiral.nn.precision import add_product, product_dtype
from meshspiral.nn.recurrence import recurrence

METRIC_FEATURES = 2  # distance and angle
# Initial bias of the forget gate. The centre is read first; after 20 elements the cell still holds
# sigmoid(3)^20 = 38 % of it. With the usual bias of 1 it holds 0.2 %, and the layer hardly learns.
FORGET_BIAS = 3.0
# Spirals gathered at a time. Smaller chunks took 5 % longer; larger ones only used more memory.
ROWS = 2048


def metric_features(vertices: Tensor, spirals: Tensor, unit: Tensor | float) -> Tensor:
    """Distance and angle of each spiral element, the "++" variant of Lim et al. 2018.

    For element c of the spiral around a, with b the element before c: the distance |c - a| / unit,
    and the angle at a between b and c. The angle of the centre and of the first neighbour is 0.
    Padding has distance 0 and angle 0.

    Args:
        vertices: Vertex positions, float [V, 3].
        spirals: Vertex indices, int64 [V, N], padded with -1.
        unit: Length to divide distances by, in the unit of `vertices`; a number or a scalar tensor.
            It should follow the size of the shape, not its tessellation.

    Returns:
        float [V, N, 2]: relative distances, and angles in radians.
    """
    padding = spirals < 0
    points = F.embedding(spirals.clamp(min=0), vertices)
    rays = points - points[:, :1]
    lengths = rays.norm(dim=2)
    angles = torch.zeros_like(lengths)
    previous, current = rays[:, 1:-1], rays[:, 2:]
    # atan2 of sine and cosine is accurate at all angles; acos loses half its digits near 0 and pi
    angles[:, 2:] = torch.atan2(
        torch.linalg.cross(previous, current).norm(dim=2), (previous * current).sum(dim=2)
    )
    features = torch.stack([lengths / unit, angles], dim=2)
    return features.masked_fill_(padding[..., None], 0.0)


class SpiralLinear(nn.Module):
    """A linear map of the concatenated features of a spiral: the FCS layer of Lim et al. 2018.

    It has out_features * length * (in_features + 2 if metric) weights and out_features biases.
    Padding contributes zeros. Under autocast, products are computed in autocast's dtype and
    gradients are accumulated in float32.

    Args:
        in_features: Number of input channels per vertex.
        out_features: Number of output channels per vertex.
        length: Number of elements N of every spiral, padding included.
        metric: Whether the layer also takes metric features.
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
        """Apply the layer.

        Args:
            features: Vertex features, float [V, in_features].
            spirals: Vertex indices, int64 [V, length], padded with -1.
            metric: Metric features, float [V, length, 2]; required if the layer was built with
                `metric`, ignored otherwise.

        Returns:
            float [V, out_features].

        Raises:
            ValueError: The spirals do not have the layer's length.
        """
        if spirals.shape[1] != self.length:
            raise ValueError(f"spirals must have length {self.length}, got {spirals.shape[1]}")
        out = _SpiralProduct.apply(features, self.linear.weight, self.linear.bias, spirals)
        return out if self.metric is None else out + self.metric(metric.flatten(1))


class _SpiralProduct(torch.autograd.Function):
    """features[spirals] weight^T + bias, with zeros at padding.

    The gathered features are N times as large as the features, so only ROWS spirals are gathered
    at a time. The backward pass gathers them again, which is cheaper than saving them.
    """

    @staticmethod
    def forward(ctx, features, weight, bias, spirals):
        dtype = product_dtype(weight)
        zero_row = len(features)  # the index that padding points to
        features = torch.cat([features, features.new_zeros(1, features.shape[1])]).to(dtype)
        weight, bias = weight.to(dtype), bias.to(dtype)
        indices = spirals.where(spirals >= 0, zero_row)
        out = features.new_empty(len(spirals), len(weight))
        for start in range(0, len(spirals), ROWS):
            rows = slice(start, start + ROWS)
            gathered = features.index_select(0, indices[rows].reshape(-1))
            torch.addmm(bias, gathered.view(-1, weight.shape[1]), weight.T, out=out[rows])
        ctx.save_for_backward(features, weight, indices)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        features, weight, indices = ctx.saved_tensors
        sum_dtype = torch.promote_types(weight.dtype, torch.float32)  # for sums over vertices
        d_features = torch.zeros_like(features, dtype=sum_dtype)
        d_weight = torch.zeros_like(weight, dtype=sum_dtype)
        for start in range(0, len(indices), ROWS):
            rows = slice(start, start + ROWS)
            flat = indices[rows].reshape(-1)
            gathered = features.index_select(0, flat).view(-1, weight.shape[1])
            add_product(d_weight, grad[rows].T, gathered)
            torch.mm(grad[rows], weight, out=gathered)  # now the gradient of the gathered features
            d_features.index_add_(0, flat, gathered.view(len(flat), -1).to(sum_dtype))
        return d_features[:-1], d_weight, grad.sum(0, dtype=sum_dtype), None


class SpiralLSTM(nn.Module):
    """An LSTM along the spiral; its output is the hidden state at the last element before padding.

    Spirals may differ in length; each has at least one element. The gates are stored in the order
    input, forget, cell, output, with one bias each, so the layer has
    4 out_features (in_features + 2 if metric + out_features + 1) parameters.

    Args:
        in_features: Number of input channels per vertex.
        out_features: Size of the hidden state.
        metric: Whether the layer also takes metric features.
        recompute: Whether to save memory by computing the steps again in the backward pass.
    """

    def __init__(
        self, in_features: int, out_features: int, metric: bool = False, recompute: bool = False
    ):
        super().__init__()
        self.recompute = recompute
        gates = 4 * out_features
        self.input = nn.Linear(in_features, gates)
        self.metric = nn.Linear(METRIC_FEATURES, gates, bias=False) if metric else None
        self.hidden = nn.Linear(out_features, gates, bias=False)
        # fan_out is out_features, not 4 out_features: each gate is a separate linear map
        for layer in filter(None, (self.input, self.metric)):
            glorot(layer.weight, in_features + METRIC_FEATURES * metric, out_features)
        glorot(self.hidden.weight, out_features, out_features)
        nn.init.zeros_(self.input.bias)
        nn.init.constant_(self.input.bias[out_features : 2 * out_features], FORGET_BIAS)

    def forward(self, features: Tensor, spirals: Tensor, metric: Tensor | None = None) -> Tensor:
        """Apply the layer. The backward pass can run only once (see `recurrence`).

        Args:
            features: Vertex features, float [V, in_features].
            spirals: Vertex indices, int64 [V, N], padded with -1; the first column has no padding.
            metric: Metric features, float [V, N, 2]; required if the layer was built with
                `metric`, ignored otherwise.

        Returns:
            float [V, out_features].
        """
        # Project vertices, not spiral elements: a vertex contributes the same to the gates in every
        # spiral, so V products suffice instead of V N.
        information = (None, None) if self.metric is None else (metric, self.metric.weight)
        projected = self.input(features)
        return recurrence(projected, self.hidden.weight, spirals, *information, self.recompute)


def glorot(weight: Tensor, fan_in: int, fan_out: int) -> None:
    """Fill a weight with Glorot-uniform values in place (Glorot and Bengio 2010).

    `nn.init.xavier_uniform_` derives the fans from the shape; here they are arguments, so that
    `weight` can be one block of a larger matrix.

    Args:
        weight: The weight or block, of any shape.
        fan_in: Number of inputs of the whole matrix.
        fan_out: Number of outputs of the whole matrix.
    """
    bound = (6.0 / (fan_in + fan_out)) ** 0.5
    nn.init.uniform_(weight, -bound, bound)


def dense(in_features: int, out_features: int) -> nn.Linear:
    """A fully connected layer per vertex, with Glorot-uniform weights and zero biases.

    Args:
        in_features: Number of input channels.
        out_features: Number of output channels.
    """
    layer = nn.Linear(in_features, out_features)
    nn.init.xavier_uniform_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer
