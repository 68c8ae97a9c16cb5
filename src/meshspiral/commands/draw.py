"""Draw the neighbourhoods of one vertex: `python -m src.draw data=bodies_mixed`."""

from __future__ import annotations

import logging
from pathlib import Path

from meshspiral.experiment.entry import entry_point
from meshspiral.experiment.schema import ConfigError, DrawConfig

log = logging.getLogger(__name__)
KINDS = ("png", "pdf")


@entry_point("draw", DrawConfig)
def main(config: DrawConfig) -> None:
    import numpy as np

    from meshspiral.data.files import write_file
    from meshspiral.data.sources import open_shapes
    from meshspiral.data.tensors import sequence_points
    from meshspiral.neighbourhoods import Neighbourhood
    from meshspiral.viz.plots import encoded, neighbourhood_figure

    shapes = open_shapes(config.data)
    names = [name for split in shapes.names.values() for name in split]
    if not names:
        raise ConfigError("the data set has no shape to draw")
    name = config.shape or next(iter(shapes.names["test"]), names[0])
    if name not in names:
        raise ConfigError(f"shape must be a shape of the data set, got {name}; see src.meshes")
    count = len(shapes.template.vertices)
    if config.vertex >= count:
        raise ConfigError(f"vertex must be below {count}, the template's size, got {config.vertex}")
    shapes.prepare([name])
    shape, source = shapes.load(name), shapes.source(name)
    drawn = {name: shape} if source is None else {"as registered": source, "as remeshed": shape}
    wanted, panels = shapes.template.vertices[config.vertex], []
    for tessellation, shape in drawn.items():
        apart = np.linalg.norm(shapes.template.vertices[shape.labels] - wanted, axis=1)
        vertex = int(apart.argmin())
        for settings in config.neighbourhoods.values():
            around = Neighbourhood.of(settings)
            points = sequence_points(shape.mesh, around, vertex)
            panels.append((f"{tessellation}: {around.title}", shape.mesh, vertex, points))
    figure = neighbourhood_figure(panels, shapes.up, columns=len(config.neighbourhoods))
    for kind in KINDS:
        path = Path(f"{config.output}.{kind}")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, encoded(figure, kind))
        log.info("Written: %s", path)


if __name__ == "__main__":
    main()
