"""Statistics of the meshes of a data set: size, topology, tessellation, and distance to the source.

They show what a network could learn from the tessellation alone, and how exact the labels are.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh

from meshspiral.data.shapes import Shape, ShapeSet
from meshspiral.geometry.barycentric import interpolate
from meshspiral.geometry.connectivity import fans
from meshspiral.geometry.faces import directed_edges
from meshspiral.geometry.mesh import Mesh, used_vertices
from meshspiral.geometry.remesh import closest_points


class MeshStatistics(NamedTuple):
    """Statistics of one mesh. Lengths are in units of its mean edge length.

    Attributes:
        vertices: Number of vertices.
        faces: Number of faces.
        components: Number of connected components.
        manifold: Whether the faces at every vertex are a single fan; edges have at most two faces
            in any case.
        closed: Whether there is no boundary: every edge has two faces.
        genus: Sum over the components; None if the surface is not closed.
        as_source: Whether `components`, `closed` and `genus` are those of the mesh that this one
            was remeshed from; None if it was not remeshed.
        edge_variation: Standard deviation of the edge lengths over their mean.
        min_angle: Median over all faces of the smallest angle, in degrees.
        shared_edges: Share of the edges that another mesh has too, see `shared_edges`; None without
            another mesh.
        source_distance: Two-sided Hausdorff distance to the mesh that this one was remeshed from,
            at vertices; None if it was not remeshed.
        label_distance: Mean distance from the true point on the template to the label; None if the
            true points are the labels.
    """

    vertices: int
    faces: int
    components: int
    manifold: bool
    closed: bool
    genus: int | None
    as_source: bool | None
    edge_variation: float
    min_angle: float
    shared_edges: float | None
    source_distance: float | None
    label_distance: float | None


def mesh_statistics(
    shape: Shape, other: Shape | None, shapes: ShapeSet, name: str
) -> MeshStatistics:
    """The statistics of a shape.

    Args:
        shape: The shape.
        other: The shape to compare edges with, if there is one.
        shapes: The data set.
        name: The name of the shape in the data set.
    """
    mesh, solid = shape.mesh, _solid(shape.mesh)
    lengths = solid.edges_unique_length
    as_source = source_distance = label_distance = None
    if source := shapes.source(name):
        as_source = _topology(solid) == _topology(_solid(source.mesh))
        source_distance = hausdorff_distance(mesh, source.mesh) / lengths.mean()
    if shape.points is not None:
        template = shapes.template.vertices
        points = interpolate(template, *shape.points)
        label_distance = np.linalg.norm(points - template[shape.labels], axis=1).mean()
        label_distance /= lengths.mean()
    components, closed, genus = _topology(solid)
    return MeshStatistics(
        vertices=len(mesh.vertices),
        faces=len(mesh.faces),
        components=components,
        manifold=bool((fans(mesh) <= 1).all()),
        closed=closed,
        genus=genus,
        as_source=as_source,
        edge_variation=float(lengths.std() / lengths.mean()),
        min_angle=float(np.median(np.degrees(solid.face_angles.min(axis=1)))),
        shared_edges=shared_edges(shape, other) if other else None,
        source_distance=source_distance,
        label_distance=label_distance,
    )


def mean_statistics(rows: list[MeshStatistics]) -> list[float]:
    """The mean of each statistic over the meshes that have it; NaN if none has."""
    columns = zip(*rows, strict=True)
    known = ([value for value in column if value is not None] for column in columns)
    return [float(np.mean(values or [np.nan])) for values in known]


def hausdorff_distance(one: Mesh, other: Mesh) -> float:
    """The largest distance from a vertex of either mesh to the surface of the other."""
    pairs = (one, other), (other, one)
    return max(
        float(closest_points(surface, mesh.vertices, mesh.vertex_normals)[2].max())
        for mesh, surface in pairs
    )


def shared_edges(shape: Shape, other: Shape) -> float:
    """The share of a shape's edges that another shape has too, in 0..1.

    Edges are equal if their ends have the same labels.
    """
    own, others = labelled_edges(shape), labelled_edges(other)
    return len(own & others) / max(len(own), 1)


def labelled_edges(shape: Shape) -> set[tuple[int, int]]:
    """The undirected edges of a shape as pairs of labels, without those between equal labels."""
    pairs = shape.labels[directed_edges(shape.mesh.faces)]
    pairs = np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1)
    return set(map(tuple, np.unique(pairs, axis=0).tolist()))


def _solid(mesh: Mesh) -> trimesh.Trimesh:
    """The mesh without vertices on no face, which trimesh would count as components."""
    used, faces = used_vertices(mesh.faces)
    return trimesh.Trimesh(mesh.vertices[used], faces, process=False)


def _topology(solid: trimesh.Trimesh) -> tuple[int, bool, int | None]:
    """Components, whether they are all closed, and if so the sum of their genera."""
    components, closed = int(solid.body_count), bool(solid.is_watertight)
    return components, closed, int(components - solid.euler_number // 2) if closed else None
