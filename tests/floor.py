"""The mean error of a network that gives every vertex its label:

    python -m tests.floor bodies_mixed bodies_remeshed

Labels are vertices of the template; true points lie within its faces.
"""

from __future__ import annotations

import sys

import numpy as np

from meshspiral.data.cache import Cache
from meshspiral.data.reference import ReferenceDistances
from meshspiral.data.sources import open_shapes
from meshspiral.evaluation.metrics import at_vertices, point_errors
from tests.helpers import composed


def main() -> None:
    for name in sys.argv[1:]:
        data = composed([f"data={name}"]).data
        shapes = open_shapes(data)
        shapes.prepare(shapes.names["test"])
        reference = ReferenceDistances(shapes.template, Cache(data.cache_dir))
        errors = []
        for shape in map(shapes.load, shapes.names["test"]):
            labels = at_vertices(shape.labels)
            errors.append(point_errors(labels, shape.points, reference, reference.place))
        print(f"{name}: {np.concatenate(errors).mean():.4f}")


if __name__ == "__main__":
    main()
