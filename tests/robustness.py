"""How robust labels are to changes of a mesh, measured outside the test suite:

    python -m tests.robustness 5
    python -m tests.robustness 20 --rows mixed_1100 bumps --run <run_folder>
    python -m tests.robustness 10 --split val --run <run_folder>

Labels that many of the 20 test bodies, or of the 10 for validation, with the bundled network or
that of a run. Prints for each change of the bodies, and for each option of the matcher: the share
of exact matches; the mean error of the labels, and that of the points within faces, to the true
points over the square root of the template's area; the share of labels with an error up to 0.05;
the share of flips; and the median seconds of a mesh. A flip is a label that is more than 0.1 off,
but at most 0.05 from the mirror image of the true vertex.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import trimesh
from tqdm import tqdm

from meshspiral import Matcher, Mesh, scan
from meshspiral.data.cache import Cache
from meshspiral.data.damaged import bumpy, warped
from meshspiral.data.datasets.bodies import Bodies
from meshspiral.data.reference import ReferenceDistances
from meshspiral.data.remeshed import Remeshed
from meshspiral.data.shapes import Shape, SurfacePoints
from meshspiral.evaluation.metrics import at_vertices, geodesic_errors, point_errors
from meshspiral.evaluation.outcome import evenly
from meshspiral.geometry.remesh import closest_points
from meshspiral.matching.flips import mirror_images

CACHE = Cache("outputs/cache")
TESSELLATIONS = [  # policy, number of vertices
    ("isotropic", 750),
    ("isotropic", 1500),
    ("isotropic", 3000),
    ("isotropic", 7000),
    ("isotropic", 15000),
    ("mixed", 1500),
    ("mixed", 1100),
]
OPTIONS = {
    "default": {},
    "unflip=false": {"unflip": False},
    "ensemble=true": {"ensemble": True},
    "refine=crf": {"refine": "crf"},
    "refine=zoomout": {"refine": "zoomout"},
}


def with_mesh(body: Shape, vertices: np.ndarray, faces: np.ndarray) -> Shape:
    return Shape(Mesh(vertices, faces, body.mesh.name), body.labels, body.template_size)


def rotate(body: Shape, rng: np.random.Generator) -> Shape:
    rotation = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    return with_mesh(body, body.mesh.vertices @ rotation.T, body.mesh.faces)


def scale_and_move(body: Shape, rng: np.random.Generator) -> Shape:
    return with_mesh(body, 1000 * body.mesh.vertices + np.array([1e6, 0, 0]), body.mesh.faces)


def renumber(body: Shape, rng: np.random.Generator) -> Shape:
    return body.renumbered(rng.permutation(len(body.mesh.vertices)))


def add_noise(body: Shape, rng: np.random.Generator) -> Shape:
    vertices = body.mesh.vertices
    return with_mesh(body, vertices + rng.normal(scale=0.002, size=vertices.shape), body.mesh.faces)


def warp(body: Shape, rng: np.random.Generator) -> Shape:
    mesh = body.mesh
    return with_mesh(body, warped(mesh.vertices, 0.02, mesh.size, rng), mesh.faces)


def add_bumps(body: Shape, rng: np.random.Generator, slope: float) -> Shape:
    return with_mesh(body, bumpy(body.mesh, slope, rng), body.mesh.faces)


def remove_faces(body: Shape, rng: np.random.Generator) -> Shape:
    faces = body.mesh.faces
    return with_mesh(body, body.mesh.vertices, faces[rng.random(len(faces)) >= 0.1])


def cut_at_the_waist(body: Shape, rng: np.random.Generator) -> Shape:
    vertices, faces = body.mesh.vertices, body.mesh.faces
    keep = vertices[:, 2] > np.median(vertices[:, 2])
    return with_mesh(body, vertices, faces[keep[faces].all(axis=1)])


def three_parts(body: Shape, rng: np.random.Generator) -> Shape:
    """By the template's rest pose, in which the arms point sideways."""
    vertices = Bodies(len(body.labels)).template.vertices
    neck = np.quantile(vertices[:, 2], 0.9)
    keep = (vertices[:, 2] > neck) | (vertices[:, 0] > 0.16 * np.ptp(vertices[:, 0]))
    faces = body.mesh.faces
    return with_mesh(body, body.mesh.vertices, faces[keep[faces].all(axis=1)])


CHANGES: dict[str, Callable[[Shape, np.random.Generator], Shape]] = {
    "unchanged": lambda body, rng: body,
    "rotated": rotate,
    "times 1000, moved by 1 km": scale_and_move,
    "renumbered": renumber,
    "noise of 2 mm": add_noise,
    "warped, amplitude 0.02": warp,
    "a tenth of the faces removed": remove_faces,
    "cut off at the waist": cut_at_the_waist,
    "an arm, the head, part of a leg": three_parts,
    "bumps, slope 0.4": partial(add_bumps, slope=0.4),
    "bumps, slope 0.7": partial(add_bumps, slope=0.7),
}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("bodies", type=int)
    parser.add_argument("--run", type=Path)
    parser.add_argument("--split", choices=["val", "test"], default="test")
    parser.add_argument(
        "--rows",
        nargs="*",
        default=[],
        help="such as mixed_1100, or part of a title; default: all",
    )
    parser.add_argument("--options", nargs="*", choices=OPTIONS, default=list(OPTIONS))
    words = parser.parse_args()
    bodies = Bodies(1500)
    names = evenly(bodies.names[words.split], words.bodies)
    reference = ReferenceDistances(bodies.template, CACHE)
    originals = [bodies.load(name) for name in names]
    rng = np.random.default_rng(0)
    cases = {}
    for title, change in CHANGES.items():
        changed = [change(body, rng) for body in originals]  # always, to draw the same
        if not words.rows or any(row in title for row in words.rows):
            cases[title] = changed
    for policy, vertices in TESSELLATIONS:
        if words.rows and f"{policy}_{vertices}" not in words.rows:
            continue
        remeshed = Remeshed(bodies, CACHE, None, policy, vertices)
        remeshed.prepare(names)
        cases[f"{policy}, {vertices:,} vertices"] = [remeshed.load(name) for name in names]
    matchers = [Matcher.load(words.run, **OPTIONS[name]) for name in words.options]
    mirror = mirror_images(bodies.template, bodies.up)
    print(f"{'':44}" + "".join(f"{name:>52}" for name in words.options))
    for title, shapes in cases.items():
        print_row(title, [measure(matcher, shapes, reference, mirror) for matcher in matchers])


def print_row(title: str, values: list[tuple[float, ...]]) -> None:
    columns = (
        f"{100 * e:8.1f} % {m:7.4f} {p:7.4f} {100 * w:6.1f} % {100 * f:5.1f} % {s:6.2f} s"
        for e, m, p, w, f, s in values
    )
    print(f"{title:44}" + "".join(columns), flush=True)


def on_surface(points: np.ndarray, template: Mesh) -> SurfacePoints:
    face, weights, _ = closest_points(template, points, np.full_like(points, np.nan))
    return SurfacePoints(template.faces[face], weights)


def measure(
    matcher: Matcher, shapes: list[Shape], reference: ReferenceDistances, mirror: np.ndarray
) -> tuple[float, ...]:
    """The six numbers of a cell, means over the meshes but for the median of the seconds."""
    rows, seconds = [], []
    for shape in tqdm(shapes, leave=False):
        began = time.perf_counter()
        labels = matcher.label(scan(shape.mesh.vertices, shape.mesh.faces, "a"))
        seconds.append(time.perf_counter() - began)
        known = labels.template >= 0
        predicted, true = labels.template[known].astype(np.int64), shape.labels[known]
        truth = at_vertices(shape.labels) if shape.points is None else shape.points
        truth = SurfacePoints(*(array[known] for array in truth))
        error = point_errors(at_vertices(predicted), truth, reference, reference.place)
        points = on_surface(labels.points[known], reference.template)
        between = point_errors(points, truth, reference, reference.place)
        flipped = geodesic_errors(predicted, mirror[true], reference)
        flips = (error > 0.1) & (flipped <= 0.05)
        rows.append(
            [
                (predicted == true).mean(),
                error.mean(),
                between.mean(),
                (error <= 0.05).mean(),
                flips.mean(),
            ]
        )
    return *np.mean(rows, axis=0), np.median(seconds)


if __name__ == "__main__":
    main()
