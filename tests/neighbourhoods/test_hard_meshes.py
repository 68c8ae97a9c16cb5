"""Neighbourhoods from the frame on the meshes that people have: holes, bow ties, folded faces."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.spirals import spiral_table
from meshspiral.nn.geodesic import Resampling, resample
from tests.meshes import bow_tie, bumpy_sphere, lattice, punctured, two_cones, union
from tests.neighbourhoods.made import sampled, spiral, tensors_of


def folded(mesh: Mesh) -> Mesh:
    """The mesh with two vertices of one face at the same point, and another face without area."""
    vertices = mesh.vertices.copy()
    vertices[mesh.faces[7, 1]] = vertices[mesh.faces[7, 0]]
    a, b, c = mesh.faces[-1]
    vertices[c] = (vertices[a] + vertices[b]) / 2
    return Mesh(vertices, mesh.faces)


MESHES = {
    "boundary": lattice(5, 6),
    "holes": punctured(bumpy_sphere(), 0.2),
    "bow tie": bow_tie(),
    "two cones": two_cones(),
    "no area": folded(bumpy_sphere()),
    "one face": Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]),
    "isolated": union(bumpy_sphere(), Mesh([[0, 0, 0]], [])),
}
SPIRALS = {
    "frame": {"start": "frame"},
    "dilation": {"dilation": 2},
    "dilation from the frame": {"dilation": [1, 2, 3], "start": "frame", "jitter": 1},
    "pooled": {"start": "frame", "pooled": 3},
}
GRIDS = {
    "sampled": {},
    "sampled, radius for each layer": {"radius": [0.2, 0.4, 0.8], "jitter": 1},
    "sampled, pooled": {"start": "random", "pooled": 3},
    "blended": {"blend": True},
    "blended, random": {"blend": True, "start": "random"},
    "blended, radius for each layer": {"blend": True, "radius": [0.2, 0.4, 0.8], "pooled": 2},
}
FROM_THE_FRAME = [grid for name, grid in GRIDS.items() if name != "blended, random"]
every_mesh = pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)


def drawn(mesh: Mesh, neighbourhood, seed: int = 0, training: bool = True) -> dict:
    tensors = tensors_of(mesh, neighbourhood)
    return neighbourhood.draw(tensors, torch.Generator().manual_seed(seed), training)


def by_layer(entry) -> tuple:
    return entry if isinstance(entry, tuple) else (entry,)


@every_mesh
@pytest.mark.parametrize("settings", SPIRALS.values(), ids=SPIRALS)
def test_spirals_are_rows_of_their_vertex(mesh, settings):
    steps = settings.get("dilation", 1)
    steps = steps if isinstance(steps, list) else [steps]
    table = spiral_table(mesh, 1 + 3 * max(steps))
    layers = by_layer(drawn(mesh, spiral(4, **settings))["spirals"])
    for step, layer in zip(steps, layers, strict=True):
        assert layer.dtype == torch.int64
        for v, rows in enumerate(layer.view(len(mesh.vertices), -1, 4).tolist()):
            own = table.sequences[table.first[v] : table.first[v + 1]][:, ::step][:, :4].tolist()
            assert all(row[0] == v and row in own for row in rows)


@every_mesh
@pytest.mark.parametrize("settings", GRIDS.values(), ids=GRIDS)
def test_places_are_whole_and_near_their_vertex(mesh, settings):
    neighbourhood = sampled(**settings)
    batch = drawn(mesh, neighbourhood)
    radii = settings.get("radius", 0.4)
    radii = radii if isinstance(radii, list) else [radii]
    spirals = by_layer(batch["spirals"])
    places = by_layer(batch.get("places") or (None,) * len(radii))
    longest = max((np.linalg.norm(mesh.vertices[a] - mesh.vertices[b]) for a, b in edges(mesh)))
    for radius, rows, layer in zip(radii, spirals, places, strict=True):
        points = torch.from_numpy(mesh.vertices)
        if layer is not None:
            points = resample(points, Resampling(**layer))
        assert rows.min() >= 0 and rows.max() < len(points)
        around = points[rows].view(len(mesh.vertices), -1, 11, 3).numpy()
        assert np.isfinite(around).all()
        apart = np.linalg.norm(around - mesh.vertices[:, None, None], axis=3)
        assert apart[:, :, 0].max() < 1e-6
        assert apart.max() < radius * mesh.size + longest  # a place's vertex is within one edge


def edges(mesh: Mesh) -> list:
    return [(face[i], face[i - 1]) for face in mesh.faces for i in range(3)]


@pytest.mark.parametrize("name", ["boundary", "holes", "isolated"])
@pytest.mark.parametrize("settings", [SPIRALS["dilation"], *FROM_THE_FRAME])
def test_renumbering_renumbers_them(name, settings):
    """By the points that they visit: a place halfway between two vertices may take either.

    Not at bow ties, where any of the fans may be the first.
    """
    mesh = bumped(MESHES[name])
    settings = settings | {"start": "frame", "jitter": 0}
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    make = spiral if "dilation" in settings else sampled
    neighbourhood = make(6, **settings) if make is spiral else make(**settings)

    def visited(mesh):
        batch = drawn(mesh, neighbourhood, training=False)
        spirals, points = by_layer(batch["spirals"]), torch.from_numpy(mesh.vertices)
        places = by_layer(batch.get("places") or (None,) * len(spirals))
        return [
            (points if layer is None else resample(points, Resampling(**layer)))[rows].numpy()
            for layer, rows in zip(places, spirals, strict=True)
        ]

    for ours, theirs in zip(visited(mesh), visited(mesh.renumbered(order)), strict=True):
        same = np.isclose(theirs, ours[order], atol=1e-5).reshape(len(mesh.vertices), -1)
        assert same.all(axis=1).mean() > 0.95


def bumped(mesh: Mesh) -> Mesh:
    """The mesh with its vertices moved a little, so that no frame or place is a tie."""
    noise = np.random.default_rng(1).normal(scale=0.05, size=mesh.vertices.shape)
    return Mesh(mesh.vertices + noise, mesh.faces)
