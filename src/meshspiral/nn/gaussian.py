"""The Gaussian mixture convolution of MoNet (Monti et al. 2017) on geodesic polar coordinates."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from meshspiral.nn.layers import ROWS, dense
from meshspiral.nn.precision import product_dtype


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
        with torch.autocast(features.device.type, enabled=False):
            weights = self.weights(disks).to(features.dtype)
        means = _MeansOfDisks.apply(features, weights, disks.vertices, product_dtype(features))
        return self.linear(means.flatten(1))

    def weights(self, disks: Disks) -> Tensor:
        """The weights of all vertices under all Gaussians, float [V, rings * rays, K]."""
        dtype = self.mean_distance.dtype
        distances, angles = (x.to(dtype)[:, None] for x in disks[1:])
        scale = torch.exp(-self.log_width)[..., None] * 0.5**0.5
        exponents = ((distances - self.mean_distance[:, None]) * scale[:, 0]).square()
        turned = angles - self.mean_angle[:, None]
        turned = turned - 2 * math.pi * torch.round(turned.detach() / (2 * math.pi))
        exponents = exponents + (turned * scale[:, 1] * (distances > 0)).square()
        exponents = exponents.masked_fill((disks.vertices < 0)[:, None], math.inf)
        return torch.softmax(-exponents, dim=2)


class _MeansOfDisks(torch.autograd.Function):
    """Sums of features over disks, with weights: float [V, J, C].

    The gathered features are K times as large as the features, so only ROWS disks are gathered at a
    time, in both passes.
    """

    @staticmethod
    def forward(ctx, features, weights, vertices, dtype):
        features, weights = features.to(dtype), weights.to(dtype)
        indices = vertices.clamp(min=0).long()  # a weight of 0 there
        ctx.save_for_backward(features, weights, indices)
        out = features.new_empty(*weights.shape[:2], features.shape[1])
        for start in range(0, len(indices), ROWS):
            rows = slice(start, start + ROWS)
            torch.bmm(weights[rows], _gathered(features, indices[rows]), out=out[rows])
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        features, weights, indices = ctx.saved_tensors
        grad = grad.to(features.dtype)
        sum_dtype = torch.promote_types(features.dtype, torch.float32)
        d_features = torch.zeros_like(features, dtype=sum_dtype)
        d_weights = torch.empty_like(weights)
        for start in range(0, len(indices), ROWS):
            rows = slice(start, start + ROWS)
            gathered = _gathered(features, indices[rows])
            torch.bmm(grad[rows], gathered.mT, out=d_weights[rows])
            torch.bmm(weights[rows].mT, grad[rows], out=gathered)
            d_features.index_add_(0, indices[rows].flatten(), gathered.flatten(0, 1).to(sum_dtype))
        return d_features, d_weights, None, None


def _gathered(features: Tensor, indices: Tensor) -> Tensor:
    """features[indices], float [rows, K, C]."""
    return features.index_select(0, indices.flatten()).view(*indices.shape, -1)
