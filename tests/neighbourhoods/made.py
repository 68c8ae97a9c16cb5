"""Neighbourhoods with settings for tests."""

from __future__ import annotations

from meshspiral.neighbourhoods.patch import Patch
from meshspiral.neighbourhoods.spiral import Spiral


def spiral(seq_len: int, rings: int | None = None) -> Spiral:
    return Spiral(Spiral.Settings(name="spiral", seq_len=seq_len, rings=rings))


def patch(radius=0.1, rings=3, rays=8, weights="interpolation") -> Patch:
    settings = {"radius": radius, "rings": rings, "rays": rays, "weights": weights}
    return Patch(Patch.Settings(name="patch", **settings))
