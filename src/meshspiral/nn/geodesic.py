"""The geodesic convolution of Masci, Boscaini, Bronstein and Vandergheynst (2015)."""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from meshspiral.nn.layers import glorot


class Resampling(NamedTuple):
    """The samples of every vertex's polar grid as weighted sums of vertices: a sparse matrix.

    Sample s = (v * rays + ray) * rings + ring is the sum over k in first[s]:first[s+1] of
    weights[k] times the features of vertices[k]. A sample that is not there, since the surface ends
    before it, has no k, and is 0. The same by columns, for gradients: vertex v is in samples[k],
    with sample_weights[k], for k in sample_first[v]:sample_first[v+1].

    vertices, samples: int32 [E]. weights, sample_weights: float [E].
    first: int32 [V * rays * rings + 1]. sample_first: int32 [V + 1].
    """

    vertices: Tensor
    weights: Tensor
    first: Tensor
    samples: Tensor
    sample_weights: Tensor
    sample_first: Tensor


def resample(features: Tensor, resampling: Resampling) -> Tensor:
    """float [V * rays * rings, C], the samples of features [V, C]."""
    return _Resample.apply(features, *resampling)


class _Resample(torch.autograd.Function):
    """Forwards and backwards a sum over rows: no two threads add to one place."""

    @staticmethod
    def forward(ctx, features, vertices, weights, first, *columns):
        ctx.columns = columns
        return _sum_rows(features, vertices, weights, first)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        return _sum_rows(grad.contiguous(), *ctx.columns), *[None] * 6


def _sum_rows(x: Tensor, indices: Tensor, weights: Tensor, first: Tensor) -> Tensor:
    return F.embedding_bag(
        indices,
        x,
        first,
        mode="sum",
        include_last_offset=True,
        per_sample_weights=weights.to(x.dtype),
    )


class GeodesicConv(nn.Module):
    """The correlation of every patch with a template on the polar grid, at its best rotation.

    out[v, o] = max over t of the sum over ray, ring and c of
    weight[o, ray, ring, c] * sample[v, (ray + t) modulo rays, ring, c]: a patch's first ray is
    arbitrary, and does not matter. rays * rings weights per pair of channels, and no bias.

    To try all rotations is a circular correlation along the rays. It is formed as a product of
    Fourier coefficients: at 16 rays 8 products of complex numbers instead of 16 * 16 of real ones.

    Takes features float [V, in_features] and their resampling; gives float [V, out_features].
    Errors: ValueError unless rays is even.
    """

    def __init__(self, in_features: int, out_features: int, rings: int = 5, rays: int = 16):
        super().__init__()
        if rays % 2:
            raise ValueError(f"rays must be even, got {rays}")
        self.weight = nn.Parameter(torch.empty(out_features, rays, rings, in_features))
        glorot(self.weight, rays * rings * in_features, out_features)

    def forward(self, features: Tensor, resampling: Resampling) -> Tensor:
        outs, rays, *_ = self.weight.shape
        half, width = rays // 2, self.weight[0, 0].numel()
        features = features.to(self.weight.dtype)
        basis = _fourier_basis(rays, features.dtype, features.device)
        exact = torch.autocast(features.device.type, enabled=False)
        with exact:
            samples = resample(features, resampling).view(-1, rays, width)
            spectrum = (basis @ samples).view(-1, half, 2 * width).transpose(0, 1)
            template = basis @ self.weight.view(outs, rays, width)
            template = template.view(outs, half, 2, width).permute(2, 1, 3, 0) * rays**0.5
            for_real, for_imaginary = _conjugate_products(*template)
        real, imaginary = spectrum.bmm(for_real), spectrum.bmm(for_imaginary)
        with exact:
            return _LargestRotation.apply(real, imaginary, basis)


@cache
def _fourier_basis(rays: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """[rays, rays], orthonormal: in rows 2k and 2k + 1 the real and the imaginary part of frequency
    k; beside frequency 0, which has no imaginary part, frequency rays / 2, which has none either.
    """
    turn = torch.arange(rays, dtype=torch.float64) * (2 * math.pi / rays)
    k = torch.arange(rays // 2, dtype=torch.float64)[:, None]
    basis = torch.stack([torch.cos(k * turn), -torch.sin(k * turn)], dim=1) * 2**0.5
    basis[0] = torch.stack([torch.ones_like(turn), torch.cos(rays / 2 * turn)])
    return (basis.view(rays, rays) / rays**0.5).to(device, dtype)


def _conjugate_products(real: Tensor, imaginary: Tensor) -> tuple[Tensor, Tensor]:
    """The matrices by which coefficients (x, y) go to those of a correlation with a template.

    (real - i imaginary)(x + i y) = (x real + y imaginary) + i (y real - x imaginary); the first
    frequency holds two real ones, which go their own ways. All [half, width, outs]; returned are
    two [half, 2 width, outs], for the real and the imaginary part.
    """
    paired = real.new_full((len(real), 1, 1), 0.5**0.5)
    paired[0] = 0.0
    alone = real.new_zeros(len(real), 1, 1)
    alone[0] = 1.0
    for_real = torch.cat([real * (paired + alone), imaginary * paired], dim=1)
    for_imaginary = torch.cat([imaginary * -paired, real * paired + imaginary * alone], dim=1)
    return for_real, for_imaginary


class _LargestRotation(torch.autograd.Function):
    """From Fourier coefficients along the rotations, 2 [rays / 2, V, outs], the maximum [V, outs].

    Of all rotations only the best takes part in the gradient: it is never written out for others.
    """

    @staticmethod
    def forward(ctx, real, imaginary, basis):
        pairs, vertices, outs = real.shape
        flat = [part.to(basis.dtype).view(pairs, -1) for part in (real, imaginary)]
        rotations = (basis[0::2].T @ flat[0]).addmm_(basis[1::2].T, flat[1])
        largest, best = rotations.view(2 * pairs, vertices, outs).max(dim=0)
        ctx.save_for_backward(best, basis)
        ctx.dtype = real.dtype
        return largest

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        best, basis = ctx.saved_tensors
        shape = (len(basis) // 2, *grad.shape)
        parts = (
            rows.index_select(1, best.view(-1)).view(shape).mul_(grad).to(ctx.dtype)
            for rows in (basis[0::2], basis[1::2])
        )
        return *parts, None
