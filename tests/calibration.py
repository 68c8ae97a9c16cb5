"""How far confidences can be trusted, measured outside the test suite:

    python -m tests.calibration 20 [run folder]

Matches that many of the 20 test bodies, each to another one, with the bundled network or that of a
run. For ranges of a confidence, prints the share of vertices that are right, and in brackets the
share of all vertices that are in the range; then the share of all that are right, and the expected
calibration error. A label is right within 0.05 sqrt(area) of the true
point of the template, and a match if its target vertex belongs there.
"""

from __future__ import annotations

import itertools
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from meshspiral import Matcher, Mesh, scan
from meshspiral.data.datasets.bodies import Bodies
from meshspiral.data.reference import ReferenceDistances
from meshspiral.data.remeshed import Remeshed
from meshspiral.data.shapes import Shape, SurfacePoints
from meshspiral.evaluation.metrics import at_vertices, geodesic_errors, point_errors
from meshspiral.evaluation.outcome import evenly
from meshspiral.matching.confidence import RADIUS
from meshspiral.matching.matcher import nearest_vertices
from tests.robustness import CACHE

POLICIES = ("isotropic", "adaptive", "refined", "simplified", "marching")
BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
TENTHS = 10
SHIFT = 13  # of 20 bodies: another person, in another pose


def noisy(shape: Shape, metres: float, rng: np.random.Generator) -> Shape:
    vertices = shape.mesh.vertices
    noise = rng.normal(scale=metres, size=vertices.shape)
    return replace(shape, mesh=Mesh(vertices + noise, shape.mesh.faces))


def cut(shape: Shape, rng: np.random.Generator) -> Shape:
    """Without all that is within 12 cm of the vertex furthest from a random one."""
    vertices, faces = shape.mesh.vertices, shape.mesh.faces
    far = np.linalg.norm(vertices - vertices[rng.integers(len(vertices))], axis=1).argmax()
    keep = np.linalg.norm(vertices - vertices[far], axis=1) > 0.12
    return replace(shape, mesh=Mesh(vertices, faces[keep[faces].all(axis=1)]))


def main() -> None:
    count, run = int(sys.argv[1]), (Path(sys.argv[2]) if len(sys.argv) > 2 else None)
    bodies, rng = Bodies(1500), np.random.default_rng(0)
    names = evenly(bodies.names["test"], count)
    reference = ReferenceDistances(bodies.template, CACHE)
    registered = [bodies.load(name) for name in names]
    remeshed = []
    for policy in POLICIES:
        data = Remeshed(bodies, CACHE, None, policy, 1500)
        data.prepare(names)
        remeshed.append([data.load(name) for name in names])
    cases = {
        "registered": [registered],
        "remeshed": remeshed,
        "noise of 2 mm": [[noisy(shape, 0.002, rng) for shape in registered]],
        "noise of 5 mm": [[noisy(shape, 0.005, rng) for shape in registered]],
        "a hand, foot or head cut off": [[cut(shape, rng) for shape in remeshed[0]]],
    }
    ranges = [f"{low:.1f} to {high:.1f}" for low, high in itertools.pairwise(BINS)]
    for smooth in (False, True):
        matcher = Matcher.load(run, smooth=smooth)
        print(f"\nsmooth={str(smooth).lower()}\n| | | {' | '.join(ranges)} | all | error |")
        for title, sets in cases.items():
            found = [measure(matcher, shapes, reference) for shapes in sets]
            for kind in found[0]:
                columns = zip(*(of_set[kind] for of_set in found), strict=True)
                values = map(np.concatenate, columns)
                print(f"| {title} | {kind} | {' | '.join(bin_texts(*values))} |", flush=True)


def measure(
    matcher: Matcher, shapes: list[Shape], reference: ReferenceDistances
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Confidences, and whether each label or match is right, by the kind of confidence."""
    predicted = [
        matcher.predict(scan(shape.mesh.vertices, shape.mesh.faces, "a"))
        for shape in tqdm(shapes, leave=False)
    ]
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for i, shape in enumerate(shapes):
        j = (i + SHIFT) % len(shapes)
        (labels, distributions), (other, other_distributions) = predicted[i], predicted[j]
        known = labels.template >= 0
        match = nearest_vertices(labels, other)
        confidence = matcher.map_confidence(distributions, other_distributions, match)
        label_error = errors(shape, known, labels.template[known], reference)
        map_error = errors(shape, known, shapes[j].labels[match[known]], reference)
        exact = labels.template == shape.labels
        for kind, values, right in (
            ("`confidence`, exact", labels.confidence, exact[known]),
            ("`near_confidence`", labels.near_confidence, label_error <= RADIUS),
            ("`map_confidence`", confidence, map_error <= RADIUS),
        ):
            found.setdefault(kind, []).append((values[known], right))
    return {
        kind: tuple(map(np.concatenate, zip(*parts, strict=True))) for kind, parts in found.items()
    }


def errors(
    shape: Shape, known: np.ndarray, predicted: np.ndarray, reference: ReferenceDistances
) -> np.ndarray:
    """Distances from the true points of some vertices to vertices of the template."""
    predicted = predicted.astype(np.int64)
    if shape.points is None:
        return geodesic_errors(predicted, shape.labels[known], reference)
    true = SurfacePoints(*(array[known] for array in shape.points))
    return point_errors(at_vertices(predicted), true, reference, reference.place)


def bin_texts(confidence: np.ndarray, right: np.ndarray) -> list[str]:
    texts = []
    for low, high in itertools.pairwise(BINS):
        within = (confidence >= low) & ((confidence < high) | (high == BINS[-1]))
        share = f"{100 * right[within].mean():.0f} %" if within.any() else "\u2013"
        texts.append(f"{share} ({100 * within.mean():.0f})")
    return [*texts, f"{100 * right.mean():.0f} %", f"{expected_error(confidence, right):.3f}"]


def expected_error(confidence: np.ndarray, right: np.ndarray) -> float:
    """The expected calibration error over TENTHS ranges of equal width (Guo et al. 2017)."""
    place = np.minimum((confidence * TENTHS).astype(int), TENTHS - 1)
    difference = np.bincount(place, right - confidence.astype(np.float64), minlength=TENTHS)
    return float(np.abs(difference).sum() / len(confidence))


if __name__ == "__main__":
    main()
