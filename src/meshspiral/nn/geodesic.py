"""The geodesic convolution of Masci, Boscaini, Bronstein and Vandergheynst 2015."""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from meshspiral.nn.layers import glorot
from meshspiral.nn.precision import product_dtype


class Resampling(NamedTuple):
    """The samples of all polar grids as weighted sums of vertices: a sparse matrix in CSR and CSC.

    With S = V * rays * rings samples, sample s = (v * rays + ray) * rings + ring is the sum of
    weights[k] * features[vertices[k]] over k in first[s]:first[s + 1]. A sample beyond the boundary
    of the surface has no k and is 0. The columns serve the gradient: vertex v contributes to
    samples[k] with sample_weights[k], for k in sample_first[v]:sample_first[v + 1].

    Attributes:
        vertices: int32 [E], by sample.
        weights: float [E], by sample.
        first: int32 [S + 1].
        samples: int32 [E], by vertex.
        sample_weights: float [E], by vertex.
        sample_first: int32 [V + 1].
    """

    vertices: Tensor
    weights: Tensor
    first: Tensor
    samples: Tensor
    sample_weights: Tensor
    sample_first: Tensor


def resample(features: Tensor, resampling: Resampling) -> Tensor:
    """Sample vertex features on the polar grids.

    Args:
        features: float [V, C].
        resampling: The sparse matrix of the mesh.

    Returns:
        float [V * rays * rings, C].
    """
    return _Resample.apply(features, *resampling)


class _Resample(torch.autograd.Function):
    """A sum over rows in both passes, so that no two threads add to the same entry."""

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
    """Correlation of each patch with a template on the polar grid, maximised over rotations.

    out[v, o] is the maximum over t of the sum over ray, ring and c of
    weight[o, ray, ring, c] * sample[v, (ray + t) % rays, ring, c]. The first ray of a patch is
    arbitrary; the maximum makes the layer independent of it. The layer has rays * rings weights per
    pair of channels and no bias.

    Correlating at all rotations is a circular correlation along the rays. It is computed as a
    product of Fourier coefficients: with 16 rays, 8 complex products instead of 16 * 16 real ones.

    Args:
        in_features: Number of input channels per vertex.
        out_features: Number of output channels per vertex.
        rings: Number of rings of the polar grid.
        rays: Number of rays of the polar grid; even.

    Raises:
        ValueError: `rays` is odd.
    """

    def __init__(self, in_features: int, out_features: int, rings: int = 5, rays: int = 16):
        super().__init__()
        if rays % 2:
            raise ValueError(f"rays must be even, got {rays}")
        self.weight = nn.Parameter(torch.empty(out_features, rays, rings, in_features))
        glorot(self.weight, rays * rings * in_features, out_features)

    def forward(self, features: Tensor, resampling: Resampling) -> Tensor:
        """Apply the layer. Under autocast, only products of Fourier coefficients use its dtype.

        Args:
            features: float [V, in_features].
            resampling: The samples of the mesh's polar grids, with the layer's rays and rings.

        Returns:
            float [V, out_features].
        """
        outs, rays, *_ = self.weight.shape
        half, width = rays // 2, self.weight[0, 0].numel()
        features = features.to(self.weight.dtype)
        basis = _fourier_basis(rays, features.dtype, features.device)
        dtype = product_dtype(self.weight)
        full_precision = torch.autocast(features.device.type, enabled=False)
        with full_precision:
            samples = resample(features, resampling).view(-1, rays, width)
            spectrum = (basis @ samples).view(-1, half, 2 * width).transpose(0, 1)
            # a cast also puts it in order, without which the gradient by the weights is slow
            spectrum = spectrum.to(dtype, memory_format=torch.contiguous_format)
            template = basis @ self.weight.view(outs, rays, width)
            template = template.view(outs, half, 2, width).permute(2, 1, 3, 0) * rays**0.5
            for_real, for_imaginary = _conjugate_products(*template)
        real, imaginary = spectrum.bmm(for_real), spectrum.bmm(for_imaginary)
        with full_precision:
            return _LargestRotation.apply(real, imaginary, basis)


@cache
@torch.inference_mode(False)  # or a network could not be trained after another has predicted
def _fourier_basis(rays: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The orthonormal real Fourier basis, float [rays, rays].

    Rows 2k and 2k + 1 hold the real and imaginary part of frequency k. Frequencies 0 and rays / 2
    have no imaginary part: row 0 holds frequency 0, and row 1 holds frequency rays / 2.
    """
    turn = torch.arange(rays, dtype=torch.float64) * (2 * math.pi / rays)
    k = torch.arange(rays // 2, dtype=torch.float64)[:, None]
    basis = torch.stack([torch.cos(k * turn), -torch.sin(k * turn)], dim=1) * 2**0.5
    basis[0] = torch.stack([torch.ones_like(turn), torch.cos(rays / 2 * turn)])
    return (basis.view(rays, rays) / rays**0.5).to(device, dtype)


def _conjugate_products(real: Tensor, imaginary: Tensor) -> tuple[Tensor, Tensor]:
    """The matrices that map Fourier coefficients of samples to those of their correlation.

    For sample coefficients x + i y and template coefficients real + i imaginary:
    (real - i imaginary)(x + i y) = (x real + y imaginary) + i (y real - x imaginary).
    The first pair is not a complex number but two real ones, frequencies 0 and rays / 2, which are
    multiplied separately.

    Args:
        real: float [rays / 2, width, out_features].
        imaginary: float [rays / 2, width, out_features].

    Returns:
        Two float [rays / 2, 2 width, out_features], for the real and the imaginary part.
    """
    paired = real.new_full((len(real), 1, 1), 0.5**0.5)
    paired[0] = 0.0
    alone = real.new_zeros(len(real), 1, 1)
    alone[0] = 1.0
    for_real = torch.cat([real * (paired + alone), imaginary * paired], dim=1)
    for_imaginary = torch.cat([imaginary * -paired, real * paired + imaginary * alone], dim=1)
    return for_real, for_imaginary


class _LargestRotation(torch.autograd.Function):
    """The maximum over rotations, float [V, outs], of a correlation given by its coefficients.

    The coefficients are two float [rays / 2, V, outs], real and imaginary. Only the best rotation
    has a gradient, so the gradient of all rotations is never stored.
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
