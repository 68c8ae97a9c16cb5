"""The Gaussian mixture convolution of MoNet (Monti et al. 2017) on geodesic polar coordinates."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor, nn

from meshspiral.nn.layers import ROWS, dense
from meshspiral.nn.precision import product_dtype

CACHED_ROWS = 128  # disks at a time on a processor


class Disks(NamedTuple):
    """The vertices around every vertex.

    Attributes:
        vertices: int32 [V, K], the vertex itself first; -1 behind the end of a row.
        distances: float [V, K], over the radius of the disk, in 0..1.
        angles: float [V, K], in radians.
    """

    vertices: Tensor
    distances: Tensor
    angles: Tensor


class GaussianMixtureConv(nn.Module):
    """A sum over Gaussians of a linear map of the mean of the features under each (equations 9-11).

    Under Gaussian j, vertex u of the disk, at distance r and angle t, has the weight

        exp(-((r - m_j) / s_j)^2 / 2 - (d / w_j)^2 / 2),

    where d is the difference of t to the angle n_j, in (-pi, pi], and 0 at the centre, which lies
    in every direction. Weights of a disk are divided by their sum. The means m_j and n_j and the
    widths s_j and w_j are learnt; the latter as logarithms, so that they stay positive. They begin
    on a polar grid, with its spacings as widths: Gaussians that begin at random are often so
    narrow that no vertex is near.

    Args:
        in_features: Number of input channels per vertex.
        out_features: Number of output channels per vertex.
        rings: Number of different m_j at the start.
        rays: Number of different n_j at the start. There are rings * rays Gaussians.
    """

    def __init__(self, in_features: int, out_features: int, rings: int, rays: int):
        super().__init__()
        means = (torch.arange(rings) + 1.0) / rings, torch.arange(rays) * (2 * math.pi / rays)
        grid = torch.cartesian_prod(*means).view(-1, 2)
        self.mean_distance = nn.Parameter(grid[:, 0].clone())
        self.mean_angle = nn.Parameter(grid[:, 1].clone())
        widths = 1.0 / rings, 2 * math.pi / rays
        self.log_width = nn.Parameter(torch.log(torch.tensor(widths)).repeat(len(grid), 1))
        self.linear = dense(len(grid) * in_features, out_features)

    def forward(self, features: Tensor, disks: Disks) -> Tensor:
        """Apply the layer.

        Args:
            features: float [V, in_features].
            disks: Of the mesh.

        Returns:
            float [V, out_features].
        """
        parameters = self.mean_distance, self.mean_angle, self.log_width
        means = _MeansUnderGaussians.apply(features, *parameters, *disks, product_dtype(features))
        return self.linear(means.flatten(1))

    def weights(self, disks: Disks) -> Tensor:
        """The weights of all vertices under all Gaussians, float [V, rings * rays, K]."""
        return _weights(self.mean_distance, self.mean_angle, self.log_width, *disks)[0]


class _MeansUnderGaussians(torch.autograd.Function):
    """Means of the features under the Gaussians, float [V, J, C].

    Weights are K / C times as large as the means, and gathered features K / J times. Both are
    formed for a few disks at a time, in both passes, so that they stay in the processor's cache.
    """

    @staticmethod
    def forward(ctx, features, mean_distance, mean_angle, log_width, *rest):
        *disks, dtype = rest
        features = features.to(dtype)
        gaussians = mean_distance, mean_angle, log_width
        ctx.save_for_backward(features, *gaussians, *disks)
        out = features.new_empty(len(disks[0]), len(mean_distance), features.shape[1])
        for rows in _chunks(features, len(out)):
            weights, *_ = _weights(*gaussians, *(x[rows] for x in disks))
            torch.bmm(weights.to(dtype), _gathered(features, disks[0][rows]), out=out[rows])
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        features, mean_distance, mean_angle, log_width, *disks = ctx.saved_tensors
        gaussians = mean_distance, mean_angle, log_width
        grad = grad.to(features.dtype)
        sum_dtype = torch.promote_types(features.dtype, torch.float32)
        d_features = torch.zeros_like(features, dtype=sum_dtype)
        moments = torch.zeros(len(mean_distance), 4, device=grad.device, dtype=log_width.dtype)
        for rows in _chunks(features, len(grad)):
            vertices, distances, angles = (x[rows] for x in disks)
            weights, offsets, turned = _weights(*gaussians, vertices, distances, angles)
            gathered = _gathered(features, vertices)
            d_weights = torch.bmm(grad[rows], gathered.mT).to(weights.dtype)
            d_exponents = d_weights.mul_(weights)
            d_exponents -= weights * d_exponents.sum(2, keepdim=True)  # of the softmax
            for k, offset in ((0, offsets), (2, turned)):
                product = d_exponents * offset
                moments[:, k] += product.sum((0, 2))
                moments[:, k + 1] += product.mul_(offset).sum((0, 2))
            torch.bmm(weights.to(features.dtype).mT, grad[rows], out=gathered)
            flat = vertices.clamp(min=0).flatten()
            d_features.index_add_(0, flat, gathered.flatten(0, 1).to(sum_dtype))
        # the exponent is -(offset / width)^2 / 2
        narrow = torch.exp(-2 * log_width)
        d_log_width = narrow * moments[:, 1::2]
        d_means = narrow * moments[:, 0::2]
        return d_features, d_means[:, 0], d_means[:, 1], d_log_width, None, None, None, None


def _chunks(features: Tensor, count: int) -> Iterator[slice]:
    """Slices of some rows each: those that fit the cache of a processor, or fill a GPU."""
    size = CACHED_ROWS if features.device.type == "cpu" else ROWS
    return (slice(start, start + size) for start in range(0, count, size))


def _weights(
    mean_distance: Tensor,
    mean_angle: Tensor,
    log_width: Tensor,
    vertices: Tensor,
    distances: Tensor,
    angles: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Weights under J Gaussians, and offsets from their means in distance and in angle.

    Returns:
        Three float [V, J, K].
    """
    dtype = mean_distance.dtype
    distances, angles = (x.to(dtype)[:, None] for x in (distances, angles))
    offsets = distances - mean_distance[:, None]
    turned = angles - mean_angle[:, None]
    turned -= (turned * (0.5 / math.pi)).round_().mul_(2 * math.pi)
    turned *= (distances > 0).to(dtype)
    narrow = torch.exp(-log_width)[..., None] * 0.5**0.5
    exponents = (offsets * narrow[:, 0]).square_().neg_()
    exponents -= (turned * narrow[:, 1]).square_()
    padding = torch.zeros_like(distances).masked_fill_((vertices < 0)[:, None], -math.inf)
    exponents += padding
    return torch.softmax(exponents, dim=2), offsets, turned


def _gathered(features: Tensor, vertices: Tensor) -> Tensor:
    """features[vertices], float [rows, K, C]; those of vertex 0 in the place of padding."""
    flat = vertices.clamp(min=0).flatten()
    return features.index_select(0, flat).view(*vertices.shape, -1)
