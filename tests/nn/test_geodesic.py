"""The geodesic convolution equals its definition, an explicit maximum over rotations."""

import pytest
import torch
from torch.nn import functional as F

from meshspiral.neighbourhoods.patch import by_rows_and_columns
from meshspiral.nn.geodesic import GeodesicConv, Resampling, _fourier_basis, resample

RINGS, RAYS = 5, 16


def patches(vertices, rings=RINGS, rays=RAYS, empty=0.0, seed=0):
    """Random polar grids, three vertices per sample; a share `empty` of the samples is missing.

    Returns:
        Vertices and weights [V, rays, rings, 3], and whether a sample is present [V, rays, rings].
    """
    rng = torch.Generator().manual_seed(seed)
    shape = (vertices, rays, rings, 3)
    indices = torch.randint(vertices, shape, generator=rng, dtype=torch.int32)
    weights = torch.rand(shape, generator=rng, dtype=torch.float64)
    weights = weights / weights.sum(3, keepdim=True)
    present = torch.rand(shape[:3], generator=rng) >= empty
    return indices, weights, present


def as_resampling(indices, weights, present):
    arrays = {
        "indices": indices[present].flatten().numpy(),
        "weights": weights[present].flatten(),
        "first": 3 * F.pad(present.flatten().cumsum(0), (1, 0)).int().numpy(),
    }
    arrays["weights"] = arrays["weights"].numpy()
    both = by_rows_and_columns(arrays, len(indices))
    return Resampling(**{name: torch.from_numpy(array) for name, array in both.items()})


def reference_samples(features, indices, weights, present):
    """The weighted sums of vertices, float [V, rays, rings, C]; zero where a sample is missing."""
    samples = (weights[..., None] * features[indices.long()]).sum(3)
    return samples * present[..., None]


def reference_conv(weight, samples):
    """The definition: a product for each rotation, and their maximum."""
    rotations = [
        torch.einsum("orsc,vrsc->vo", weight, samples.roll(-t, 1)) for t in range(samples.shape[1])
    ]
    return torch.stack(rotations).amax(0)


@pytest.mark.parametrize("empty", [0.0, 0.3])
def test_resampling_is_the_weighted_sum_of_vertices(empty):
    table = patches(23, empty=empty)
    features = torch.randn(23, 6, dtype=torch.float64, requires_grad=True)
    out = resample(features, as_resampling(*table))
    expected = reference_samples(features, *table).reshape(-1, 6)
    torch.testing.assert_close(out, expected)
    upstream = torch.randn_like(out)
    grads = [torch.autograd.grad(x, features, upstream)[0] for x in (out, expected)]
    torch.testing.assert_close(*grads)


def test_a_missing_sample_is_zero():
    indices, weights, present = patches(9, empty=0.5)
    out = resample(torch.ones(9, 1), as_resampling(indices, weights, present))
    torch.testing.assert_close(out.flatten(), present.flatten().float())


@pytest.mark.parametrize("rings, rays", [(5, 16), (1, 2), (3, 6), (2, 8)])
@pytest.mark.parametrize("empty", [0.0, 0.3])
def test_values_and_gradients_equal_those_of_explicit_rotations(rings, rays, empty):
    layer = GeodesicConv(7, 9, rings, rays).double()
    table = patches(31, rings, rays, empty)
    features = torch.randn(31, 7, dtype=torch.float64, requires_grad=True)
    out = layer(features, as_resampling(*table))
    expected = reference_conv(layer.weight, reference_samples(features, *table))
    torch.testing.assert_close(out, expected, rtol=0, atol=1e-10)
    upstream = torch.randn_like(out)
    actual, reference = (
        torch.autograd.grad(x, [features, layer.weight], upstream) for x in (out, expected)
    )
    for a, b in zip(actual, reference, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-10)


def test_rotating_patches_by_whole_rays_changes_nothing():
    """Each patch is rotated by its own number of rays: the choice of the first does not matter."""
    layer = GeodesicConv(4, 6).double()
    indices, weights, present = patches(19, empty=0.1)
    features = torch.randn(19, 4, dtype=torch.float64)
    shifts = torch.randint(RAYS, (19,))
    rays = (torch.arange(RAYS) + shifts[:, None]) % RAYS
    rotated = [table[torch.arange(19)[:, None], rays] for table in (indices, weights, present)]
    assert not torch.equal(rotated[0], indices)
    a = layer(features, as_resampling(indices, weights, present))
    b = layer(features, as_resampling(*rotated))
    torch.testing.assert_close(a, b, rtol=0, atol=1e-12)


def test_mirrored_patches_give_another_result():
    """The layer is invariant to rotations of a patch, not to reflections."""
    layer = GeodesicConv(4, 6).double()
    indices, weights, present = patches(19)
    features = torch.randn(19, 4, dtype=torch.float64)
    a = layer(features, as_resampling(indices, weights, present))
    b = layer(features, as_resampling(*(x.flip(1) for x in (indices, weights, present))))
    assert (a - b).abs().max() > 1e-3


def test_eighty_weights_per_pair_of_channels_and_no_bias():
    [weight] = GeodesicConv(16, 32).parameters()
    assert weight.numel() == 80 * 16 * 32


def test_an_odd_number_of_rays_is_rejected():
    with pytest.raises(ValueError, match="rays must be even, got 15"):
        GeodesicConv(4, 6, rays=15)


def test_float32_is_accurate_to_1e_5():
    layer = GeodesicConv(16, 32)
    table = patches(50)
    features = torch.randn(50, 16)
    out = layer(features, as_resampling(*table)).double()
    exact = reference_conv(layer.weight.double(), reference_samples(features.double(), *table))
    torch.testing.assert_close(out, exact, rtol=0, atol=1e-5)


def test_autocast_changes_values_and_gradients_by_little():
    torch.manual_seed(0)
    layer = GeodesicConv(8, 8)
    resampling = as_resampling(*patches(40))
    features = torch.randn(40, 8, requires_grad=True)
    exact = layer(features, resampling)
    with torch.autocast("cpu", torch.bfloat16):
        out = layer(features.bfloat16(), resampling)
    assert (out - exact).abs().max() < 0.03 * exact.abs().max()
    inputs = [features, layer.weight]
    grads = [torch.autograd.grad(x.sum(), inputs) for x in (out, exact)]
    for a, b in zip(*grads, strict=True):
        assert a.dtype == torch.float32
        assert (a - b).norm() < 0.1 * b.norm()  # nearly equal rotations may swap


def test_a_network_can_be_trained_after_another_has_predicted():
    """Cached tables must not be inference tensors, which autograd refuses."""
    _fourier_basis.cache_clear()
    layer, table = GeodesicConv(7, 9, RINGS, RAYS).double(), as_resampling(*patches(31))
    features = torch.randn(31, 7, dtype=torch.float64)
    with torch.inference_mode():
        layer(features, table)
    layer(features, table).sum().backward()
    assert torch.isfinite(layer.weight.grad).all()
