"""What changes of a mesh do to the labels it gets, outside the tests:

    python -m tests.robustness 20 [run folder]

On so many of the 20 test bodies, with the network that comes with the repository or another: exact
match, and the mean error to the true point on the template, over the square root of its area.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
import trimesh
from tqdm import tqdm

from meshspiral.data.cache import Cache
from meshspiral.data.datasets.bodies import Bodies
from meshspiral.data.reference import ReferenceDistances
from meshspiral.data.remeshed import Remeshed
from meshspiral.data.scans import scan
from meshspiral.data.shapes import Shape
from meshspiral.evaluation.metrics import geodesic_errors, point_errors
from meshspiral.evaluation.outcome import evenly
from meshspiral.matching.matcher import Matcher

STORE = Cache("outputs/cache")
HOLES = "a tenth of the faces gone"


def changed(body: Shape, what: str, rng: np.random.Generator) -> Shape:
    vertices, faces = body.mesh.vertices, body.mesh.faces
    if what == "rotated":
        turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
        vertices = vertices @ turn.T
    elif what == "times 1000, moved by 1 km":
        vertices = 1000 * vertices + np.array([1e6, 0, 0])
    elif what == "renumbered":
        return body.renumbered(rng.permutation(len(vertices)))
    elif what == "noise of 2 mm":
        vertices = vertices + rng.normal(scale=0.002, size=vertices.shape)
    elif what == HOLES:
        faces = faces[rng.random(len(faces)) >= 0.1]
    elif what == "cut off at the waist":
        keep = vertices[:, 2] > np.median(vertices[:, 2])
        faces = faces[keep[faces].all(axis=1)]
    return Shape(type(body.mesh)(vertices, faces, body.mesh.name), body.labels, body.template_size)


def main() -> None:
    count, run = int(sys.argv[1]), (sys.argv[2] if len(sys.argv) > 2 else None)
    bodies = Bodies(1500)
    names = evenly(bodies.names["test"], count)
    reference = ReferenceDistances(bodies.template, STORE)
    plain = [bodies.load(name) for name in names]
    rng = np.random.default_rng(0)
    cases = {
        what: [changed(body, what, rng) for body in plain]
        for what in (
            "as they are",
            "rotated",
            "times 1000, moved by 1 km",
            "renumbered",
            "noise of 2 mm",
            HOLES,
            "cut off at the waist",
        )
    }
    for policy, vertices in [
        ("isotropic", 750),
        ("isotropic", 1500),
        ("isotropic", 3000),
        ("isotropic", 15000),
        ("mixed", 1500),
    ]:
        made = Remeshed(bodies, STORE, None, policy, vertices)
        made.prepare(names)
        cases[f"{policy}, {vertices:,} vertices"] = [made.load(name) for name in names]
    options = {
        "default": {},
        "smooth": {"smooth": True},
        "never resampled": {"resampled": False},
        "always resampled": {"resampled": True},
    }
    print(f"{'':36}" + "".join(f"{name:>26}" for name in options))
    matchers = [Matcher.load(run and Path(run), **each) for each in options.values()]
    cases["the same, repair=true"] = cases[HOLES]
    for what, shapes in cases.items():
        mend = "repair" in what
        row = [measured(matcher, shapes, reference, mend) for matcher in matchers]
        print(
            f"{what:36}" + "".join(f"{100 * e:8.1f} % {m:7.4f} {s:6.2f} s" for e, m, s in row),
            flush=True,
        )
    for what in ("as they are", "isotropic, 1,500 vertices", "mixed, 1,500 vertices"):
        print(f"by confidence, {what}:\n{by_confidence(matchers[0], cases[what], reference)}")


def by_confidence(matcher: Matcher, shapes: list[Shape], reference: ReferenceDistances) -> str:
    """The share of vertices in each fifth of the confidences, and how far off they are."""
    found = [matcher.label(scan(s.mesh.vertices, s.mesh.faces, s.mesh.name)) for s in shapes]
    confidence = np.concatenate([labels.confidence for labels in found])
    errors = np.concatenate(
        [
            geodesic_errors(labels.template.astype(np.int64), shape.labels, reference)
            for labels, shape in zip(found, shapes, strict=True)
        ]
    )
    lines = []
    for low in (0.0, 0.2, 0.4, 0.6, 0.8):
        among = (confidence >= low) & (confidence < low + 0.2 + (low == 0.8))
        if among.any():
            lines.append(
                f"  {low:.1f} to {low + 0.2:.1f}: {100 * among.mean():5.1f} % of the "
                f"vertices, {100 * (errors[among] == 0).mean():5.1f} % exact, "
                f"{100 * (errors[among] < 0.05).mean():5.1f} % within 0.05"
            )
    return "\n".join(lines)


def measured(matcher: Matcher, shapes: list[Shape], reference: ReferenceDistances, repair: bool):
    exact, errors, seconds = [], [], []
    for shape in tqdm(shapes, leave=False):
        began = time.perf_counter()
        labels = matcher.label(scan(shape.mesh.vertices, shape.mesh.faces, "a", repair))
        seconds.append(time.perf_counter() - began)
        known = labels.template >= 0
        found = labels.template[known].astype(np.int64)
        exact.append((found == shape.labels[known]).mean())
        if shape.points is None:
            error = geodesic_errors(found, shape.labels[known], reference)
        else:
            true = (array[known] for array in shape.points)
            error = point_errors(found, *true, reference, reference.place)
        errors.append(error.mean())
    return np.mean(exact), np.mean(errors), np.median(seconds)


if __name__ == "__main__":
    main()
