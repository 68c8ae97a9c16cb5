"""List the meshes of a data set: `python -m src.meshes data=bodies_remeshed`."""

from __future__ import annotations

import logging

from meshspiral.data.shapes import SPLITS, DataError
from meshspiral.experiment.entry import entry_point
from meshspiral.experiment.schema import MeshesConfig

log = logging.getLogger(__name__)
COLUMNS = {  # title: meaning
    "vertices": "number of vertices",
    "faces": "number of faces",
    "components": "number of connected components",
    "manifold": "the faces at every vertex are a single fan",
    "closed": "there is no boundary",
    "genus": "summed over the components",
    "as source": "components, closed and genus are those of the original mesh",
    "edge cv": "standard deviation of the edge lengths over their mean",
    "min angle": "median of the faces' smallest angles, in degrees",
    "shared": "share of the edges that the mesh above has too, between vertices of equal "
    "labels; for the first mesh: that the last one has",
    "off source": "Hausdorff distance to the original mesh over the mean edge length",
    "off label": "mean distance from the true point to its label over the mean edge length",
}
WIDTHS = [max(len(title), 6) for title in COLUMNS]


@entry_point("meshes", MeshesConfig)
def main(config: MeshesConfig) -> None:
    from meshspiral.data.sources import open_shapes
    from meshspiral.data.statistics import mean_statistics, mesh_statistics

    shapes = open_shapes(config.data)
    splits = SPLITS if config.split is None else (config.split,)
    names = [name for split in splits for name in shapes.names[split]]
    if not names:
        subject = f"the split {config.split}" if config.split else "the data set"
        raise DataError(f"{subject} must have at least 1 mesh, got 0")
    shapes.prepare(names)
    for title, meaning in COLUMNS.items():
        log.info("%s: %s", title, meaning)
    width = max(map(len, names))
    log.info("\n%s", " ".join([" " * width, *(map(str.rjust, COLUMNS, WIDTHS))]))
    rows, previous = [], shapes.load(names[-1]) if len(names) > 1 else None
    for name in names:  # no progress bar: the rows show the progress
        shape = shapes.load(name)
        rows.append(mesh_statistics(shape, previous, shapes, name))
        previous = shape
        log.info("%s", " ".join([name.ljust(width), *map(format_value, rows[-1], WIDTHS)]))
    means = mean_statistics(rows)
    log.info("%s", " ".join(["mean".ljust(width), *map(format_value, means, WIDTHS)]))


def format_value(value: float | int | bool | None, width: int) -> str:
    """A value of a statistic, in a column's width; - for None and NaN."""
    if value is None or value != value:
        text = "-"
    elif isinstance(value, bool):
        text = "yes" if value else "no"
    else:
        text = f"{value:.2f}" if isinstance(value, float) else str(value)
    return text.rjust(width)


if __name__ == "__main__":
    main()
