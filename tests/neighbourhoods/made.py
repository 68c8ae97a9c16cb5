"""Neighbourhoods with settings for tests, and batches of one mesh."""

from __future__ import annotations

from meshspiral.data.descriptors import Features
from meshspiral.data.descriptors.xyz import Xyz
from meshspiral.data.tensors import mesh_tensors
from meshspiral.neighbourhoods.patch import Patch
from meshspiral.neighbourhoods.sampled import Sampled
from meshspiral.neighbourhoods.spiral import Spiral

STARTS = {"start": "random", "support": 0.8, "by_area": False, "jitter": 0, "pooled": 1}


def spiral(seq_len: int, rings: int | None = None, dilation=1, **starts) -> Spiral:
    settings = {"seq_len": seq_len, "rings": rings, "dilation": dilation} | STARTS | starts
    return Spiral(Spiral.Settings(name="spiral", **settings))


def sampled(radius=0.4, rings=2, rays=5, blend=False, relative_to="area", **starts) -> Sampled:
    grid = {"radius": radius, "rings": rings, "rays": rays, "relative_to": relative_to}
    settings = grid | {"blend": blend} | STARTS | {"start": "frame"} | starts
    return Sampled(Sampled.Settings(name="sampled", **settings))


def patch(radius=0.1, rings=3, rays=8, weights="interpolation", ring_width=2.0) -> Patch:
    settings = {
        "radius": radius,
        "rings": rings,
        "rays": rays,
        "weights": weights,
        "ring_width": ring_width,
    }
    return Patch(Patch.Settings(name="patch", **settings))


def tensors_of(mesh, neighbourhood) -> dict:
    """A batch of a mesh, described by its positions, with nothing drawn yet."""
    features = Features((Xyz(Xyz.Settings(rotate=False)),), 1.0)
    return {**mesh_tensors(mesh, features, neighbourhood), "index": 0}
