"""The bundled human bodies: a data set like FAUST that needs no registration."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

import numpy as np
from pydantic import Field

from meshspiral.data.settings import DataSettings
from meshspiral.data.shapes import (
    DataError,
    Shape,
    ShapeSet,
    file_stamp,
    registered_shape,
    subject_split,
)
from meshspiral.geometry.mesh import Mesh

Size = Literal[1500, 6890]


class Bodies(ShapeSet, name="bodies"):
    """100 registered human bodies, 10 subjects in 10 poses, in metres (source: see NOTICE).

    Order and split are those of FAUST: shape i shows subject i // 10 in pose i % 10. All bodies
    have the template's connectivity, so vertex i has label i, and are closed 2-manifolds of
    genus 0. Both sizes show the same bodies.

    Args:
        vertices: 1500, or 6890 with 13,776 faces, as in FAUST.

    Raises:
        DataError: There is no such size.
    """

    up = "z"

    class Settings(DataSettings):
        vertices: Size = Field(description="vertices of the template and the bodies")

    def __init__(self, vertices: int = 1500) -> None:
        if vertices not in get_args(Size):
            raise DataError(f"vertices must be 1500 or 6890, got {vertices!r}")
        self._file = Path(__file__).parents[1] / "assets" / f"bodies_{int(vertices)}.npz"
        with np.load(self._file, allow_pickle=False) as file:
            arrays = dict(file)
        self._offset, self._scale = arrays["offset"], arrays["scale"]
        self._faces = arrays["faces"]
        self._grid = dict(zip(arrays["names"].tolist(), arrays["verts"], strict=True))
        self.names = subject_split(list(self._grid))
        self.template = self._mesh("template", arrays["template"])

    def load(self, name: str) -> Shape:
        if name not in self._grid:
            raise DataError(f"no body is named {name!r}; the first is {next(iter(self._grid))!r}")
        return registered_shape(self._mesh(name, self._grid[name]), self.template)

    def stamp(self, name: str) -> str:
        return file_stamp(self._file)

    def _mesh(self, name: str, grid: np.ndarray) -> Mesh:
        """The mesh of quantised coordinates.

        Args:
            name: Name of the mesh.
            grid: Coordinates in steps of at most 0.04 mm from the lower corner of the bounding box
                of all bodies, uint16 [V, 3].
        """
        return Mesh(self._offset + grid * self._scale, self._faces, name)
