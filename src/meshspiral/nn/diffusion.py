"""The layers of DiffusionNet (Sharp, Attaiki, Crane, Ovsjanikov 2022)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from meshspiral.nn.dropout import Dropout
from meshspiral.nn.geodesic import Resampling, resample

LEAST_TIME = 1e-8


class SurfaceOperators(NamedTuple):
    """What the layers know of a surface. Lengths are over the square root of its area.

    Attributes:
        values: float [K], eigenvalues of the Laplacian.
        functions: float [V, K], its eigenfunctions, orthonormal with respect to the masses.
        masses: float [V].
        gradients: A sparse matrix [2 V, V]; rows 2 v and 2 v + 1 give the gradient at vertex v
            in two orthonormal directions of its tangent plane.
    """

    values: Tensor
    functions: Tensor
    masses: Tensor
    gradients: Resampling

    def to(self, dtype: torch.dtype) -> SurfaceOperators:
        """The same with floats of another dtype."""
        *spectral, gradients = self
        return SurfaceOperators(*(x.to(dtype) for x in spectral), gradients)


class LearnedDiffusion(nn.Module):
    """Diffusion of every channel for a time of its own, which is learnt (equations 2 and 5).

    The output is functions exp(-values time) functions^T (masses x): the heat equation, solved in
    the basis of the eigenfunctions. All times begin at `LEAST_TIME`, and stay at least so.

    Args:
        channels: Number of channels.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.time = nn.Parameter(torch.full((channels,), LEAST_TIME))

    def forward(self, x: Tensor, operators: SurfaceOperators) -> Tensor:
        """Diffuse x, float [V, channels]."""
        values, functions, masses, _ = operators
        with torch.no_grad():
            self.time.clamp_(min=LEAST_TIME)  # of the parameter, so that its gradient stays
        spectrum = functions.T @ (masses[:, None] * x)
        return functions @ (torch.exp(-values[:, None] * self.time) * spectrum)


class GradientFeatures(nn.Module):
    """Scalar products of the channels' gradients, after learnt turns and scalings (equation 8).

    With z the gradients as complex numbers and A a complex matrix that is learnt, the output is
    tanh(Re(conj(z) * A z)). It does not depend on the directions that gradients are given in. A
    reflection of the surface changes it.

    Args:
        channels: Number of channels.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.real = nn.Linear(channels, channels, bias=False)
        self.imaginary = nn.Linear(channels, channels, bias=False)

    def forward(self, gradients: Tensor) -> Tensor:
        """The features.

        Args:
            gradients: float [V, 2, channels].

        Returns:
            float [V, channels].
        """
        a, b = self.real(gradients), self.imaginary(gradients)
        along, across = gradients[:, 0], gradients[:, 1]
        turned = along * (a[:, 0] - b[:, 1]) + across * (a[:, 1] + b[:, 0])
        return torch.tanh(turned)


class DiffusionBlock(nn.Module):
    """A block: diffusion, gradient features, and a perceptron at every vertex, added to the input.

    The perceptron reads input, diffused input and gradient features, 3 C channels, and has two
    hidden layers of C channels, with ReLU, and dropout before its second and third layer.

    Args:
        channels: Number of channels C.
        dropout: Probability of dropout.
    """

    def __init__(self, channels: int, dropout: float):
        super().__init__()
        self.diffusion = LearnedDiffusion(channels)
        self.features = GradientFeatures(channels)
        self.perceptron = nn.Sequential(
            nn.Linear(3 * channels, channels),
            nn.ReLU(),
            Dropout(dropout),
            nn.Linear(channels, channels),
            nn.ReLU(),
            Dropout(dropout),
            nn.Linear(channels, channels),
        )

    def forward(self, x: Tensor, operators: SurfaceOperators) -> Tensor:
        """Apply the block to x, float [V, channels].

        Under autocast, diffusion and gradients are computed in the dtype of x.
        """
        with torch.autocast(x.device.type, enabled=False):
            diffused = self.diffusion(x, operators)
            gradients = resample(diffused, operators.gradients).view(len(x), 2, -1)
        features = self.features(gradients)
        return x + self.perceptron(torch.cat([x, diffused, features.to(x.dtype)], dim=1)).to(
            x.dtype
        )
