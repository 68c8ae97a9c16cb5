"""What the meshes of a data set are like: `python -m src.meshes data=bodies_remeshed`."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from meshspiral.data.shapes import SPLITS, DataError, Shape, ShapeSet
from meshspiral.experiment.entry import entry_point
from meshspiral.experiment.schema import ConfigError, checked_data, typed
from meshspiral.geometry.connectivity import fans
from meshspiral.geometry.mesh import Mesh

log = logging.getLogger(__name__)
COLUMNS = (
    "vertices",
    "faces",
    "parts",
    "manifold",
    "closed",
    "genus",
    "as source",
    "edges cv",
    "least angle",
    "shared",
    "off source",
    "off label",
)


@dataclass
class Meshes:
    data: Any = None
    split: str | None = None


def check(config: DictConfig) -> DictConfig:
    plain = OmegaConf.to_container(config, resolve=True)
    data = checked_data(OmegaConf.create(plain.pop("data")))
    found = typed(OmegaConf.create(plain), Meshes)
    if found.split not in (None, *SPLITS):
        raise ConfigError(f"split must be one of {', '.join(SPLITS)}; got {found.split}")
    found.data = data
    return found


@entry_point("meshes", check)
def main(config: DictConfig) -> None:
    from meshspiral.data.sources import open_shapes

    shapes = open_shapes(OmegaConf.to_container(config.data))
    names = [n for split in SPLITS if config.split in (None, split) for n in shapes.names[split]]
    if not names:
        raise DataError(f"the data set has no mesh in its split {config.split}")
    shapes.prepare(names)
    log.info("%s", HELP)
    width = max(map(len, names))
    log.info("%s", " ".join([" " * width, *(f"{column:>11}" for column in COLUMNS)]))
    rows, before = [], shapes.load(names[-1]) if len(names) > 1 else None
    for name in tqdm(names, desc="Meshes", leave=False, delay=1.0):
        shape = shapes.load(name)
        rows.append(row(shape, before, shapes, name))
        before = shape
        tqdm.write(" ".join([name.ljust(width), *map(shown, rows[-1])]))
    means = [
        np.mean([r[i] for r in rows if r[i] is not None] or [np.nan]) for i in range(len(COLUMNS))
    ]
    log.info("%s", " ".join(["mean".ljust(width), *map(shown, map(float, means))]))


HELP = """\
parts: connected components. manifold: the faces at every vertex are one fan (at an edge there are
never more than two). closed: no boundary, every edge between two faces. as source: parts, closed
and genus are those of the mesh that it was made from. edges cv: spread of the edges' lengths over
their mean. least angle: of a face, in degrees, the median. shared: edges that join the same two
vertices of the template as one of the mesh in the line above, in the first line as one of the last
mesh. off source: the farthest that this mesh and the one it was made from
are apart, either way, over the mean edge. off label: the mean distance from the true point to its
label, over the mean edge.
"""


def shown(value: float | int | bool | None) -> str:
    if value is None or value != value:
        return f"{'-':>11}"
    if isinstance(value, float):
        return f"{value:11.2f}"
    return f"{('yes' if value else 'no') if isinstance(value, bool) else value:>11}"


def row(shape: Shape, before: Shape | None, shapes: ShapeSet, name: str) -> list[Any]:
    """The values of COLUMNS; shared is None without a mesh to compare with."""
    from meshspiral.data.remeshed import Remeshed

    mesh, solid = shape.mesh, solid_of(shape.mesh)
    lengths = solid.edges_unique_length
    as_source = off_source = off_label = None
    if isinstance(shapes, Remeshed):
        source = shapes.source(name).mesh
        as_source = topology(solid) == topology(solid_of(source))
        off_source = apart(mesh, source) / lengths.mean()
    if shape.points is not None:
        place = shapes.template.vertices
        point = np.einsum("vk,vkx->vx", shape.points.weights, place[shape.points.corners])
        off_label = np.linalg.norm(point - place[shape.labels], axis=1).mean() / lengths.mean()
    parts, closed, genus = topology(solid)
    manifold = bool((fans(mesh) <= 1).all())
    return [
        len(mesh.vertices),
        len(mesh.faces),
        parts,
        manifold,
        closed,
        genus,
        as_source,
        float(lengths.std() / lengths.mean()),
        float(np.median(np.degrees(solid.face_angles.min(axis=1)))),
        shared(shape, before) if before else None,
        off_source,
        off_label,
    ]


def solid_of(mesh: Mesh):
    import trimesh

    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def topology(solid) -> tuple[int, bool, int | None]:
    """The number of parts, whether they are closed, and if so their genus in all."""
    parts, closed = int(solid.body_count), bool(solid.is_watertight)
    return parts, closed, int(parts - solid.euler_number // 2) if closed else None


def apart(one: Mesh, two: Mesh) -> float:
    """The farthest that a vertex of one mesh is from the surface of the other."""
    from meshspiral.geometry.remesh import closest_points

    return max(
        float(closest_points(b, a.vertices, a.vertex_normals)[2].max())
        for a, b in ((one, two), (two, one))
    )


def shared(shape: Shape, other: Shape) -> float:
    """The share of this mesh's edges that the other has too, both read as edges of the template."""
    one, two = (edges(s) for s in (shape, other))
    return len(one & two) / max(len(one), 1)


def edges(shape: Shape) -> set[tuple[int, int]]:
    pairs = shape.labels[shape.mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)]
    pairs = np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1)
    return set(map(tuple, np.unique(pairs, axis=0).tolist()))


if __name__ == "__main__":
    main()
