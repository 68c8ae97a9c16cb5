"""How robust labels are to changes of a mesh, measured outside the test suite:

    python -m tests.robustness 20 [run folder]

Labels that many of the 20 test bodies with the bundled network or that of a run. Prints for each
change of the bodies, and for each option of the matcher, the share of exact matches, the mean error
to the true point over the square root of the template's area, and the median seconds of a mesh.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from tqdm import tqdm

from meshspiral import Matcher, Mesh, scan
from meshspiral.data.cache import Cache
from meshspiral.data.datasets.bodies import Bodies
from meshspiral.data.reference import ReferenceDistances
from meshspiral.data.remeshed import Remeshed
from meshspiral.data.shapes import Shape
from meshspiral.evaluation.metrics import geodesic_errors, point_errors
from meshspiral.evaluation.outcome import evenly

CACHE = Cache("outputs/cache")
HOLES = "a tenth of the faces removed"
TESSELLATIONS = [  # policy, number of vertices
    ("isotropic", 750),
    ("isotropic", 1500),
    ("isotropic", 3000),
    ("isotropic", 15000),
    ("mixed", 1500),
]
OPTIONS = {
    "default": {},
    "smooth": {"smooth": True},
    "never resampled": {"resampled": False},
    "always resampled": {"resampled": True},
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


def remove_faces(body: Shape, rng: np.random.Generator) -> Shape:
    faces = body.mesh.faces
    return with_mesh(body, body.mesh.vertices, faces[rng.random(len(faces)) >= 0.1])


def cut_at_the_waist(body: Shape, rng: np.random.Generator) -> Shape:
    vertices, faces = body.mesh.vertices, body.mesh.faces
    keep = vertices[:, 2] > np.median(vertices[:, 2])
    return with_mesh(body, vertices, faces[keep[faces].all(axis=1)])


CHANGES: dict[str, Callable[[Shape, np.random.Generator], Shape]] = {
    "unchanged": lambda body, rng: body,
    "rotated": rotate,
    "times 1000, moved by 1 km": scale_and_move,
    "renumbered": renumber,
    "noise of 2 mm": add_noise,
    HOLES: remove_faces,
    "cut off at the waist": cut_at_the_waist,
}


def main() -> None:
    count, run = int(sys.argv[1]), (Path(sys.argv[2]) if len(sys.argv) > 2 else None)
    bodies = Bodies(1500)
    names = evenly(bodies.names["test"], count)
    reference = ReferenceDistances(bodies.template, CACHE)
    originals = [bodies.load(name) for name in names]
    rng = np.random.default_rng(0)
    cases = {title: [change(body, rng) for body in originals] for title, change in CHANGES.items()}
    for policy, vertices in TESSELLATIONS:
        remeshed = Remeshed(bodies, CACHE, None, policy, vertices)
        remeshed.prepare(names)
        cases[f"{policy}, {vertices:,} vertices"] = [remeshed.load(name) for name in names]
    matchers = [Matcher.load(run, **options) for options in OPTIONS.values()]
    print(f"{'':44}" + "".join(f"{name:>26}" for name in OPTIONS))
    for title, shapes in cases.items():
        print_row(title, [measure(matcher, shapes, reference) for matcher in matchers])
    repaired = [measure(matcher, cases[HOLES], reference, repair=True) for matcher in matchers]
    print_row(f"{HOLES}, repair=true", repaired)


def print_row(title: str, values: list[tuple[float, float, float]]) -> None:
    columns = (f"{100 * e:8.1f} % {m:7.4f} {s:6.2f} s" for e, m, s in values)
    print(f"{title:44}" + "".join(columns), flush=True)


def measure(
    matcher: Matcher, shapes: list[Shape], reference: ReferenceDistances, repair: bool = False
) -> tuple[float, float, float]:
    """The share of exact matches, the mean error, and the median seconds of labelling a mesh."""
    exact, errors, seconds = [], [], []
    for shape in tqdm(shapes, leave=False):
        began = time.perf_counter()
        labels = matcher.label(scan(shape.mesh.vertices, shape.mesh.faces, "a", repair))
        seconds.append(time.perf_counter() - began)
        known = labels.template >= 0
        predicted = labels.template[known].astype(np.int64)
        exact.append((predicted == shape.labels[known]).mean())
        if shape.points is None:
            error = geodesic_errors(predicted, shape.labels[known], reference)
        else:
            true_points = (array[known] for array in shape.points)
            error = point_errors(predicted, *true_points, reference, reference.place)
        errors.append(error.mean())
    return np.mean(exact), np.mean(errors), np.median(seconds)


if __name__ == "__main__":
    main()
