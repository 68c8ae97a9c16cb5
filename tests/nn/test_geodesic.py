"""The geodesic convolution against the sixteen explicit rotations that it stands for."""

import pytest
import torch
from torch.nn import functional as F

from meshspiral.data.preprocessing import by_rows_and_columns
from meshspiral.nn.geodesic import GeodesicConv, Resampling, resample

RINGS, RAYS = 5, 16


def patches(vertices, rings=RINGS, rays=RAYS, empty=0.0, seed=0):
    """Random samples [V, rays, rings, 3] of vertices and weights, a share of them not there."""
    rng = torch.Generator().manual_seed(seed)
    shape = (vertices, rays, rings, 3)
    indices = torch.randint(vertices, shape, generator=rng, dtype=torch.int32)
    weights = torch.rand(shape, generator=rng, dtype=torch.float64)
    weights = weights / weights.sum(3, keepdim=True)
    there = torch.rand(shape[:3], generator=rng) >= empty
    return indices, weights, there


def as_resampling(indices, weights, there):
    arrays = {
        "indices": indices[there].flatten().numpy(),
        "weights": weights[there].flatten(),
        "first": 3 * F.pad(there.flatten().cumsum(0), (1, 0)).int().numpy(),
    }
    arrays["weights"] = arrays["weights"].numpy()
    both = by_rows_and_columns(arrays, len(indices))
    return Resampling(**{name: torch.from_numpy(array) for name, array in both.items()})


def samples_by_hand(features, indices, weights, there):
    """[V, rays, rings, C]"""
    samples = (weights[..., None] * features[indices.long()]).sum(3)
    return samples * there[..., None]


def plain(weight, samples):
    """The definition: one product for each rotation, and the largest."""
    rotations = [
        torch.einsum("orsc,vrsc->vo", weight, samples.roll(-t, 1)) for t in range(samples.shape[1])
    ]
    return torch.stack(rotations).amax(0)


@pytest.mark.parametrize("empty", [0.0, 0.3])
def test_resampling_is_the_weighted_sum_of_vertices(empty):
    table = patches(23, empty=empty)
    features = torch.randn(23, 6, dtype=torch.float64, requires_grad=True)
    out = resample(features, as_resampling(*table))
    expected = samples_by_hand(features, *table).reshape(-1, 6)
    torch.testing.assert_close(out, expected)
    upstream = torch.randn_like(out)
    grads = [torch.autograd.grad(x, features, upstream)[0] for x in (out, expected)]
    torch.testing.assert_close(*grads)


def test_a_sample_that_is_not_there_is_zero():
    indices, weights, there = patches(9, empty=0.5)
    out = resample(torch.ones(9, 1), as_resampling(indices, weights, there))
    torch.testing.assert_close(out.flatten(), there.flatten().float())


@pytest.mark.parametrize("rings, rays", [(5, 16), (1, 2), (3, 6), (2, 8)])
@pytest.mark.parametrize("empty", [0.0, 0.3])
def test_the_fast_layer_is_the_plain_one_in_values_and_gradients(rings, rays, empty):
    layer = GeodesicConv(7, 9, rings, rays).double()
    table = patches(31, rings, rays, empty)
    features = torch.randn(31, 7, dtype=torch.float64, requires_grad=True)
    out = layer(features, as_resampling(*table))
    expected = plain(layer.weight, samples_by_hand(features, *table))
    torch.testing.assert_close(out, expected, rtol=0, atol=1e-10)
    upstream = torch.randn_like(out)
    ours, theirs = (
        torch.autograd.grad(x, [features, layer.weight], upstream) for x in (out, expected)
    )
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-10)


def test_rotating_patches_by_whole_rays_changes_nothing():
    """Each patch by its own number of rays: which one is the first does not matter."""
    layer = GeodesicConv(4, 6).double()
    indices, weights, there = patches(19, empty=0.1)
    features = torch.randn(19, 4, dtype=torch.float64)
    shifts = torch.randint(RAYS, (19,))
    turn = (torch.arange(RAYS) + shifts[:, None]) % RAYS
    rotated = [table[torch.arange(19)[:, None], turn] for table in (indices, weights, there)]
    assert not torch.equal(rotated[0], indices)
    a = layer(features, as_resampling(indices, weights, there))
    b = layer(features, as_resampling(*rotated))
    torch.testing.assert_close(a, b, rtol=0, atol=1e-12)


def test_a_mirrored_patch_is_another_patch():
    """The layer may forget the first direction, not the sense of rotation."""
    layer = GeodesicConv(4, 6).double()
    indices, weights, there = patches(19)
    features = torch.randn(19, 4, dtype=torch.float64)
    a = layer(features, as_resampling(indices, weights, there))
    b = layer(features, as_resampling(*(x.flip(1) for x in (indices, weights, there))))
    assert (a - b).abs().max() > 1e-3


def test_eighty_weights_per_pair_of_channels_and_no_bias():
    [weight] = GeodesicConv(16, 32).parameters()
    assert weight.numel() == 80 * 16 * 32


def test_an_odd_number_of_rays_is_refused():
    with pytest.raises(ValueError, match="rays must be even, got 15"):
        GeodesicConv(4, 6, rays=15)


def test_single_precision_keeps_its_digits():
    layer = GeodesicConv(16, 32)
    table = patches(50)
    features = torch.randn(50, 16)
    out = layer(features, as_resampling(*table)).double()
    exact = plain(layer.weight.double(), samples_by_hand(features.double(), *table))
    torch.testing.assert_close(out, exact, rtol=0, atol=1e-5)


def test_under_autocast_it_trains_on():
    layer = GeodesicConv(8, 8)
    resampling = as_resampling(*patches(40))
    features = torch.randn(40, 8, requires_grad=True)
    exact = layer(features, resampling)
    with torch.autocast("cpu", torch.bfloat16):
        out = layer(features.bfloat16(), resampling)
    out.float().sum().backward()
    assert (out.float() - exact).abs().max() < 0.03 * exact.abs().max()
    assert torch.isfinite(features.grad).all() and layer.weight.grad.dtype == torch.float32
