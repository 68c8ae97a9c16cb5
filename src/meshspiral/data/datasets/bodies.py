"""Bodies that come with the repository: FAUST's shape without its registration."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from meshspiral.data.shapes import DataError, Shape, ShapeSet, registered_shape, subject_split
from meshspiral.geometry.mesh import Mesh

SIZES = (1500, 6890)


class Bodies(ShapeSet):
    """100 registered human bodies, 10 subjects in 10 poses, in metres; see NOTICE.

    In FAUST's order (shape i shows subject i // 10 in pose i % 10) and split as the paper splits
    FAUST. All have the template's connectivity and are closed 2-manifolds of genus 0; a label is a
    vertex number. vertices: 1500, or 6890 with FAUST's 13,776 faces. The two sizes show the same
    bodies. Errors: DataError for any other size.
    """

    up = "z"

    def __init__(self, vertices: int = 1500) -> None:
        if vertices not in SIZES:
            raise DataError(f"vertices: the bodies come with 1500 or 6890, got {vertices!r}")
        path = Path(__file__).parents[1] / "assets" / f"bodies_{int(vertices)}.npz"
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        self._offset, self._scale = arrays["offset"], arrays["scale"]
        self._faces = arrays["faces"]
        self._grid = dict(zip(arrays["names"].tolist(), arrays["verts"], strict=True))
        self.names = subject_split(list(self._grid))
        self.template = self._mesh("template", arrays["template"])

    def load(self, name: str) -> Shape:
        if name not in self._grid:
            raise DataError(f"no body is called {name!r}; the first is {next(iter(self._grid))!r}")
        return registered_shape(self._mesh(name, self._grid[name]), self.template)

    def _mesh(self, name: str, grid: np.ndarray) -> Mesh:
        """grid: uint16 [V, 3], steps of at most 0.04 mm from the corner of the set's box."""
        return Mesh(self._offset + grid * self._scale, self._faces, name)
