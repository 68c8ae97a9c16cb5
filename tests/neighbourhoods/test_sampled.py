"""The neighbourhood of sampled spirals: tables, starts, blending, and what networks read of it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from meshspiral.geometry.geodesics import diameter
from meshspiral.geometry.patches import first_directions
from meshspiral.geometry.sampling import nearest_corners, sampled_places, surface_directions
from meshspiral.geometry.shot import local_frames
from meshspiral.neighbourhoods.sampled import turned_columns
from meshspiral.nn.geodesic import Resampling, resample
from meshspiral.nn.layers import metric_features
from meshspiral.nn.networks import ConvNet, FCSNet, LSTMNet
from tests.meshes import bumpy_sphere, lattice, punctured, union
from tests.neighbourhoods.made import sampled, tensors_of


def drawn_from(neighbourhood, tensors, seed=0, training=False):
    return neighbourhood.draw(tensors, torch.Generator().manual_seed(seed), training)


def test_the_spiral_is_the_grid_that_starts_where_the_frame_points():
    mesh, neighbourhood = bumpy_sphere(), sampled()
    axes = local_frames(mesh.centred, 0.8 * np.sqrt(mesh.area))[:, 0]
    start = surface_directions(mesh, axes)
    table = sampled_places(mesh, 0.4 * np.sqrt(mesh.area), 2, 5, start)
    spirals = drawn_from(neighbourhood, tensors_of(mesh, neighbourhood), training=True)["spirals"]
    assert spirals.dtype == torch.int64 and neighbourhood.length == spirals.shape[1] == 11
    np.testing.assert_array_equal(spirals, nearest_corners(table))
    assert not neighbourhood.random


def test_another_start_turns_every_ring():
    assert turned_columns(2, 3).tolist() == [
        [0, 1, 2, 3, 4, 5, 6],
        [0, 2, 3, 1, 5, 6, 4],
        [0, 3, 1, 2, 6, 4, 5],
    ]


def test_random_starts_and_jitter_draw_among_the_rays():
    mesh = bumpy_sphere()
    fixed, tensors = sampled(), tensors_of(mesh, sampled())
    table = drawn_from(fixed, tensors)["spirals"][:, turned_columns(2, 5)]  # [V, start, L]

    def starts(neighbourhood, tensors, table, count=80):
        seen = [set() for _ in range(len(table))]
        for seed in range(count):
            spirals = drawn_from(neighbourhood, tensors, seed, training=True)["spirals"]
            for v, row in enumerate(spirals):
                seen[v].add(int((table[v] == row).all(dim=1).int().argmax()))
        return seen

    distinct = [v for v in range(len(table)) if len(set(map(tuple, table[v].tolist()))) == 5]
    assert len(distinct) > 100
    jittered = starts(sampled(jitter=1), tensors, table)
    assert all(jittered[v] == {0, 1, 4} for v in distinct)
    free = sampled(start="random")
    tensors = tensors_of(mesh, free)
    table = torch.from_numpy(np.asarray(tensors["sequences"][0])).long()[:, turned_columns(2, 5)]
    distinct = [v for v in range(len(table)) if len(set(map(tuple, table[v].tolist()))) == 5]
    found = starts(free, tensors, table)
    assert free.random and all(found[v] == set(range(5)) for v in distinct)


def test_a_radius_for_each_layer_gives_three_spirals():
    mesh = bumpy_sphere()
    layers = sampled(radius=[0.2, 0.4, 0.8])
    spirals = drawn_from(layers, tensors_of(mesh, layers))["spirals"]
    for radius, each in zip([0.2, 0.4, 0.8], spirals, strict=True):
        one = sampled(radius=radius)
        assert torch.equal(each, drawn_from(one, tensors_of(mesh, one))["spirals"])


def test_the_maximum_over_all_starts_does_not_depend_on_the_draw():
    torch.manual_seed(0)
    mesh = bumpy_sphere()
    features = torch.rand(len(mesh.vertices), 6)
    net = FCSNet(6, 9, 11, channels=(12, 13, 14)).eval()
    for pooled, same in ((5, True), (1, False)):
        neighbourhood = sampled(start="random", pooled=pooled)
        tensors = tensors_of(mesh, neighbourhood) | {"features": features}
        one, other = (net.embed_batch(drawn_from(neighbourhood, tensors, s)) for s in (0, 1))
        assert torch.allclose(one, other, atol=1e-6) == same


@pytest.mark.parametrize("start", ["frame", "random"])
def test_blended_features_are_those_interpolated_at_the_places(start):
    mesh, neighbourhood = punctured(bumpy_sphere(), 0.1), sampled(blend=True, start=start)
    batch = drawn_from(neighbourhood, tensors_of(mesh, neighbourhood), seed=3)
    points = resample(torch.from_numpy(mesh.vertices), Resampling(**batch["places"]))
    blended = points[batch["spirals"]].numpy()
    plain = sampled(start=start)
    vertices = drawn_from(plain, tensors_of(mesh, plain), seed=3)["spirals"]
    apart = np.linalg.norm(blended - mesh.vertices[vertices], axis=2)
    np.testing.assert_allclose(apart[:, 0], 0, atol=1e-6)
    edges = mesh.vertices[mesh.faces] - mesh.vertices[np.roll(mesh.faces, 1, axis=1)]
    assert apart.mean() > 0 and apart.max() < 0.6 * np.linalg.norm(edges, axis=2).max()
    if start == "frame":
        axes = local_frames(mesh.centred, 0.8 * mesh.size)[:, 0]
        directions = surface_directions(mesh, axes)
        known = np.isfinite(directions)
        directions = np.where(known, directions, first_directions(mesh))
        table = sampled_places(mesh, 0.4 * mesh.size, 2, 5, directions)
        expected = np.einsum("vlk,vlkx->vlx", table.weights, mesh.vertices[table.indices])
        np.testing.assert_allclose(blended[known], expected[known], atol=1e-5)


def test_the_diameter_is_another_unit():
    mesh = bumpy_sphere()
    radius = 0.2 * diameter(mesh) / mesh.size
    one, other = sampled(0.2, relative_to="diameter"), sampled(radius)
    tensors = [tensors_of(mesh, neighbourhood) for neighbourhood in (one, other)]
    assert torch.equal(tensors[0]["sequences"], tensors[1]["sequences"])


@pytest.mark.parametrize("network", [FCSNet, LSTMNet, ConvNet])
@pytest.mark.parametrize("metric", [False, True])
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"blend": True},
        {"radius": [0.2, 0.3, 0.4]},
        {"blend": True, "radius": [0.2, 0.3, 0.4]},
        {"pooled": 3},
        {"blend": True, "radius": [0.2, 0.3, 0.4], "pooled": 2},
    ],
)
def test_networks_read_it_as_they_read_sequences_layer_by_layer(network, metric, settings):
    """Against gathered features that are written out here."""
    torch.manual_seed(0)
    mesh, neighbourhood = bumpy_sphere(), sampled(**settings)
    batch = drawn_from(neighbourhood, tensors_of(mesh, neighbourhood))
    batch["features"] = torch.rand(len(mesh.vertices), 6)
    length = {} if network is LSTMNet else {"seq_len": 11}
    net = network(6, 9, channels=(12, 13, 14), metric=metric, **length).eval()
    x = torch.relu(net.lift(batch["features"]))
    for i, layer in enumerate(net.layers):
        spirals, places = batch["spirals"], batch.get("places")
        if isinstance(spirals, tuple):
            spirals, places = spirals[i], places and places[i]
        points = batch["vertices"]
        if places is not None:
            x, points = (resample(each, Resampling(**places)) for each in (x, points))
        spirals = spirals.reshape(-1, 11)
        sequences = x[spirals]
        rows = torch.arange(sequences.shape[0] * 11).view(-1, 11)
        information = None
        if metric:
            information = metric_features(points[spirals].flatten(0, 1), rows, batch["unit"])
        outputs = layer(sequences.flatten(0, 1), rows, information)
        outputs = outputs.view(len(mesh.vertices), settings.get("pooled", 1), -1)
        x = torch.relu(outputs.amax(1))
    expected = torch.relu(net.neck(x))
    torch.testing.assert_close(net.embed_batch(batch), expected, rtol=1e-4, atol=1e-5)
    net.embed_batch(batch).sum().backward()
    assert all(p.grad is not None and p.grad.any() for p in net.layers.parameters() if p.dim() > 1)


def test_settings_that_mean_nothing_are_refused():
    for radius in (0, [0.1, 0.2], [0.1, 0.2, -1]):
        with pytest.raises(ValueError, match="above 0, or three"):
            sampled(radius=radius)
    assert sampled().least_vertices == 1
    mesh = lattice(2, 2)  # fewer vertices than places
    small = sampled(start="random", support=3.0)
    assert drawn_from(small, tensors_of(union(mesh, mesh), small))["spirals"].shape == (8, 11)
