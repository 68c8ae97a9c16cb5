"""How repeatable the starts of spirals are, measured outside the test suite:

    python -m tests.repeatability

For supports of the local frame, prints the share of vertices whose start agrees within one of eight
rays: between two poses of one body, and between a body and its remesh (`data/remesh=mixed`).
"""

from __future__ import annotations

import itertools

import numpy as np
from tqdm import tqdm

from meshspiral.data.datasets.bodies import Bodies
from meshspiral.data.preprocessing import frame_task, load_task
from meshspiral.data.remeshed import Remeshed
from meshspiral.data.shapes import Shape
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.sampling import surface_directions
from meshspiral.geometry.shot import Frame
from tests.robustness import CACHE

RAY = 2 * np.pi / 8
SUPPORTS = (0.16, 0.3, 0.45)
BODIES = 6


def axes(mesh: Mesh, frame: Frame) -> np.ndarray:
    """The x axes of the local frames, float32 [V, 3]; NaN where a frame is undefined."""
    return load_task(frame_task(mesh, frame), CACHE)["frames"][:, 0]


def between_poses(a: Mesh, b: Mesh, frame: Frame) -> float:
    """The share of the vertices of two meshes of equal connectivity that start alike."""
    turn = np.subtract(*(surface_directions(mesh, axes(mesh, frame)) for mesh in (a, b)))
    return float((np.abs((turn + np.pi) % (2 * np.pi) - np.pi) <= RAY).mean())


def between_tessellations(body: Shape, remesh: Shape, frame: Frame) -> float:
    """The share of the vertices of a remesh that start as the nearest vertex of the body does."""
    place = np.empty(body.template_size, np.int64)
    place[body.labels] = np.arange(len(body.labels))
    before = axes(body.mesh, frame)[place[remesh.labels]]
    cosine = (before * axes(remesh.mesh, frame)).sum(axis=1)
    return float((cosine >= np.cos(RAY)).mean())


def main() -> None:
    bodies = Bodies(1500)
    remeshed = Remeshed(bodies, CACHE, None, "mixed", None)
    names = bodies.names["test"][:BODIES]
    remeshed.prepare(names)
    original, other = ([data.load(n) for n in names] for data in (bodies, remeshed))
    print("| support | by area | two poses | body and remesh |\n| --- | --- | --- | --- |")
    for support, by_area in itertools.product(SUPPORTS, (False, True)):
        frame = Frame(support, by_area)
        pairs = list(itertools.pairwise(original))
        poses = [between_poses(a.mesh, b.mesh, frame) for a, b in tqdm(pairs, leave=False)]
        pairs = zip(original, other, strict=True)
        remeshes = [between_tessellations(a, b, frame) for a, b in pairs]
        shares = [f"{100 * np.mean(values):.1f} %" for values in (poses, remeshes)]
        print(f"| {support} | {str(by_area).lower()} | {' | '.join(shares)} |", flush=True)


if __name__ == "__main__":
    main()
