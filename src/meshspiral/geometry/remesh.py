"""Remeshing: other tessellations of a surface, and the closest points of their vertices on it.

PyMeshLab does the remeshing: isotropic remeshing (Hoppe et al. 1993, in the explicit form of
Botsch, Kobbelt 2004), simplification by quadrics (Garland, Heckbert 1997) and marching cubes
(Lorensen, Cline 1987). Isotropic remeshing alone preserves much of the old tessellation. So the
vertices are first renumbered at random, on which the order of its steps depends, and every policy
remeshes finely before it goes to the resolution wanted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import trimesh

from meshspiral.geometry.kdtree import kd_tree
from meshspiral.geometry.mesh import Mesh, MeshError

FUSED = (0.006, 0.012)  # half the width of gaps that "fused" closes, over the size of the mesh
CELL = 0.012  # of its marching cubes, over the size of the mesh
NEAREST = 16  # faces, by their centres, that are tried first for a closest point
FACING = 0.2  # least cosine between the normal of a point and that of its closest face

Policy = Callable[["Tool", np.random.Generator], None]


class Remeshed(NamedTuple):
    """A remeshed surface, and the closest point on the source of each of its vertices.

    Attributes:
        mesh: The remeshed surface, with V vertices.
        faces: int64 [V], the face of the source that the point lies in.
        weights: float64 [V, 3], the barycentric coordinates of the point in that face.
        distance: float64 [V], the distance of the vertex from that point, in the mesh's unit.
    """

    mesh: Mesh
    faces: np.ndarray
    weights: np.ndarray
    distance: np.ndarray


def remesh(
    mesh: Mesh, vertices: int, policy: str = "isotropic", seed: int = 0, turned: bool = False
) -> Remeshed:
    """Remesh a surface; the new vertices are in random order.

    The policies:

    - isotropic: edges of equal length.
    - adaptive: edges that are shorter where the surface is curved, see `bending`.
    - refined: edges that are shorter around four random vertices.
    - simplified: a fine mesh reduced by quadrics, with triangles stretched along flat directions.
    - marching: marching cubes, with slivers; thin parts are lost. For closed surfaces.
    - fused: edges of equal length; gaps narrower than twice a distance drawn from `FUSED`, as
      between fingers, are filled. For closed surfaces.
    - mixed: one of the first five, drawn with the seed; for an open surface one of four.
    - scans: one of the six; for an open surface one of four.

    Args:
        mesh: The source.
        vertices: Number of vertices wanted. "marching" and open surfaces may have a few per cent
            fewer.
        policy: One of POLICIES or MIXTURES.
        seed: Determines all random choices.
        turned: Whether marching cubes work on the surface turned at random. Their grid is fixed:
            without a turn, most seeds give the same surface.

    Returns:
        The remeshed surface and its closest points on the source.

    Raises:
        MeshError: `vertices` is below 12, the policy is unknown, the source of "marching" or
            "fused" is not closed, the source has no area, PyMeshLab cannot remesh it to that size,
            or PyMeshLab is not installed.
    """
    if policy not in (known := [*POLICIES, *MIXTURES]):
        raise MeshError(f"policy must be one of {', '.join(known)}; got {policy!r}")
    if vertices < 12:
        raise MeshError(f"vertices must be at least 12, got {vertices}")
    if not mesh.area > 0:
        raise MeshError(f"{mesh.name}: surface area must be above 0 to remesh it, got {mesh.area}")
    rng = np.random.default_rng(seed)
    closed = not border(mesh.faces)
    if policy in MIXTURES:
        policy = str(rng.choice([p for p in MIXTURES[policy] if closed or p not in CLOSED]))
    if policy in CLOSED and not closed:
        raise MeshError(f"{mesh.name}: policy {policy} needs a closed surface")
    turn = np.eye(3)
    if turned and policy == "marching":
        turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    tool = Tool(replace(mesh, vertices=mesh.vertices @ turn.T), vertices, rng)
    try:
        _apply(POLICIES[policy], tool, rng, 0.95 if policy == "marching" else 1)
    except tool.failure as error:
        raise MeshError(f"{mesh.name}: PyMeshLab cannot remesh it ({error})") from error
    points, faces = tool.result()
    result = Mesh(points @ turn, faces, mesh.name).renumbered(rng.permutation(len(points)))
    return Remeshed(result, *closest_points(mesh, result.vertices, result.vertex_normals))


def _apply(policy: Policy, tool: Tool, rng: np.random.Generator, share: float) -> None:
    """Remesh by a policy, again with shorter edges as long as there are too few vertices.

    Args:
        policy: One of the values of POLICIES.
        tool: Holds the source, then the result.
        rng: For the policy.
        share: The least share of the number of vertices wanted, for a result without boundary.

    Raises:
        MeshError: Six times were not enough.
    """
    for _ in range(6):
        policy(tool, rng)
        count = tool.count
        if count >= (min(share, 0.9) if tool.border() else share) * tool.vertices:
            break
        tool.edge *= 0.97 * np.sqrt(count / tool.vertices)
    else:
        raise MeshError(
            f"{tool.source.name}: cannot be remeshed to {tool.vertices} vertices, got {count}"
        )
    if count > tool.vertices:
        tool.simplify()


def closest_points(
    mesh: Mesh, points: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The closest points of a surface whose normals agree with those of the queries.

    Where two parts of a surface touch, the nearest point may be on the wrong one, which faces the
    other way. Faces whose normal is off by more than arccos(FACING) are therefore considered only
    if there are no others. A query with a NaN normal agrees with every face.

    Args:
        mesh: The surface.
        points: float [Q, 3], the queries.
        normals: float [Q, 3], their unit normals.

    Returns:
        The faces of the closest points, int64 [Q]; their barycentric coordinates, float64 [Q, 3];
        and their distances, float64 [Q].
    """
    unit = mesh.mean_edge or 1.0  # trimesh compares areas with a fixed number
    triangles, points = mesh.vertices[mesh.faces] / unit, points / unit
    centres = triangles.mean(axis=1)
    reach = np.linalg.norm(triangles - centres[:, None], axis=2).max(axis=1)
    directions = mesh.face_normals / np.maximum(
        np.linalg.norm(mesh.face_normals, axis=1, keepdims=True), 1e-300
    )
    tree = kd_tree(centres)
    count = len(points)
    face, closest = np.zeros(count, dtype=np.int64), np.zeros((count, 3))
    distance = np.full(count, np.inf)

    def consider(queries: np.ndarray, faces: np.ndarray, facing: float = FACING) -> None:
        """Update the closest points from pairs of a query and a face, [P], ascending in queries."""
        # negated, so that a NaN normal agrees
        agrees = ~(np.einsum("px,px->p", normals[queries], directions[faces]) < facing)
        least = np.linalg.norm(points[queries] - centres[faces], axis=1) - reach[faces]
        worth = agrees & (least < distance[queries])
        queries, faces = queries[worth], faces[worth]
        found = trimesh.triangles.closest_point(triangles[faces], points[queries])
        far = np.linalg.norm(found - points[queries], axis=1)
        order = np.lexsort((far, queries))
        first = order[np.unique(queries[order], return_index=True)[1]]  # the nearest of each query
        nearer = first[far[first] < distance[queries[first]]]
        changed = queries[nearer]
        face[changed], closest[changed] = faces[nearer], found[nearer]
        distance[changed] = far[nearer]

    tried = min(NEAREST, len(centres))
    apart, near = (x.reshape(count, tried) for x in tree.query(points, k=tried))
    consider(np.repeat(np.arange(count), tried), near.ravel())
    # a face is no nearer than its centre less its reach; the centres not tried are beyond `apart`
    unsure = np.flatnonzero((distance > apart[:, -1] - reach.max()) & np.isfinite(distance))
    others = tree.query_ball_point(points[unsure], distance[unsure] + reach.max())
    if len(unsure):
        consider(np.repeat(unsure, [len(o) for o in others]), np.concatenate(others).astype(int))
    for facing in (FACING, -np.inf):
        for query in np.flatnonzero(np.isinf(distance)):
            consider(np.full(len(centres), query), np.arange(len(centres)), facing)
    return face, _barycentric(triangles[face], closest), distance * unit


def _barycentric(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Barycentric coordinates, float64 [Q, 3], of points on triangles, [Q, 3] and [Q, 3, 3].

    Where a triangle has hardly any area, they are taken along its longest edge. The unit of length
    is about an edge.
    """
    weights = trimesh.triangles.points_to_barycentric(triangles, points)
    weights = np.clip(np.nan_to_num(weights, nan=1 / 3), 0, None)
    weights /= weights.sum(axis=1, keepdims=True)
    off = np.linalg.norm(np.einsum("qk,qkx->qx", weights, triangles) - points, axis=1)
    for q in np.flatnonzero(off > 1e-9):
        edges = np.roll(triangles[q], -1, axis=0) - triangles[q]
        squares = (edges**2).sum(axis=1)
        a = int(squares.argmax())
        along = (points[q] - triangles[q, a]) @ edges[a] / squares[a] if squares[a] > 0 else 0.0
        weights[q] = 0.0
        weights[q, a], weights[q, (a + 1) % 3] = 1 - np.clip(along, 0, 1), np.clip(along, 0, 1)
    return weights


def border(faces: np.ndarray) -> int:
    """The number of boundary edges of faces, int [F, 3]."""
    edges = trimesh.geometry.faces_to_edges(faces)
    return len(trimesh.grouping.group_rows(np.sort(edges, axis=1), require_count=1))


def bending(mesh: Mesh, radius: float) -> np.ndarray:
    """How strongly the surface bends around each vertex.

    This is 1 minus the length of the mean of the normals within the radius. On a sphere of radius R
    it is about (radius / 2R)^2. Normals that point the other way belong to another sheet and do not
    count.

    Args:
        mesh: The surface.
        radius: In the mesh's unit. It is at least two of the mesh's own mean edges.

    Returns:
        float64 [V], in 0..1.
    """
    radius = max(radius, 2 * equilateral_edge(mesh.area, len(mesh.vertices)))
    normals = np.nan_to_num(mesh.vertex_normals)
    one, other = kd_tree(mesh.vertices).query_pairs(radius, output_type="ndarray").T
    agree = np.einsum("px,px->p", normals[one], normals[other]) > 0
    one, other = one[agree], other[agree]
    total, count = normals.copy(), np.ones(len(normals))
    for vertex, near in ((one, other), (other, one)):
        np.add.at(total, vertex, normals[near])
        np.add.at(count, vertex, 1)
    return 1 - np.linalg.norm(total, axis=1) / count


def equilateral_edge(area: float, vertices: int) -> float:
    """The edge length of a closed mesh of equilateral triangles.

    Args:
        area: Its surface area.
        vertices: Its number of vertices.

    Returns:
        The length, in the unit of the area's square root.
    """
    return float(np.sqrt(2 / np.sqrt(3) * area / vertices))


class Tool:
    """One mesh in PyMeshLab.

    Every parameter is passed in every call, because PyMeshLab remembers those of earlier calls.

    Args:
        mesh: The source.
        vertices: Number of vertices wanted.
        rng: Renumbers the source.

    Attributes:
        edge: The edge length of an isotropic mesh with the number of vertices wanted. `remesh`
            shortens it if the result has too few.
        failure: The type of PyMeshLab's exceptions.

    Raises:
        MeshError: PyMeshLab is not installed.
    """

    def __init__(self, mesh: Mesh, vertices: int, rng: np.random.Generator):
        try:
            import pymeshlab
        except ImportError as error:
            raise MeshError("remeshing needs PyMeshLab: pip install pymeshlab") from error
        self._lab, self.source, self.vertices, self._rng = pymeshlab, mesh, vertices, rng
        self.failure = pymeshlab.PyMeshLabException
        self.area = mesh.area
        self.edge = equilateral_edge(self.area, vertices)
        self.reset()

    def reset(self) -> None:
        """Start again from the source, with vertices and faces in random order."""
        mesh = self.source.renumbered(self._rng.permutation(len(self.source.vertices)))
        faces = self._rng.permutation(mesh.faces)
        self._set = self._lab.MeshSet()
        self._set.add_mesh(self._lab.Mesh(mesh.vertices, faces))

    @property
    def count(self) -> int:
        """The number of vertices."""
        return self._set.current_mesh().vertex_number()

    def result(self) -> tuple[np.ndarray, np.ndarray]:
        """The vertices, float64 [V, 3], and faces, int32 [F, 3], without isolated vertices."""
        self._set.meshing_remove_unreferenced_vertices()
        mesh = self._set.current_mesh()
        return mesh.vertex_matrix(), mesh.face_matrix()

    def border(self) -> int:
        """The number of boundary edges."""
        return border(self._set.current_mesh().face_matrix())

    def isotropic(self, edge: float, times: int, selected=False) -> None:
        """Remesh isotropically to an edge length, in `times` iterations; only the selected faces if
        `selected`."""
        self._set.meshing_isotropic_explicit_remeshing(
            iterations=times,
            adaptive=False,
            selectedonly=selected,
            targetlen=self._lab.PureValue(edge),
            featuredeg=180.0,
            checksurfdist=True,
            maxsurfdist=self._lab.PureValue(0.1 * self.edge),
            splitflag=True,
            collapseflag=True,
            swapflag=True,
            smoothflag=True,
            reprojectflag=True,
        )

    def simplify(self, selected=False, placement=False) -> None:
        """Simplify by quadrics to the number of vertices wanted.

        Args:
            selected: Collapse edges of selected faces alone. If these are too few, nothing happens.
            placement: Move the vertex of a collapsed edge to its best position, instead of to an
                end of the edge.
        """
        mesh = self._set.current_mesh()
        faces = mesh.selected_face_number() if selected else mesh.face_number()
        fewer = 2 * (self.count - self.vertices)  # a collapsed edge has two faces, at a border one
        fewer -= int(self.border() * (1 - np.sqrt(self.vertices / self.count)))
        if not 0 < fewer < faces:
            return
        self._set.meshing_decimation_quadric_edge_collapse(
            targetfacenum=faces - fewer,
            targetperc=0.0,
            qualitythr=0.1,
            preserveboundary=False,
            boundaryweight=1.0,
            preservenormal=True,
            preservetopology=True,
            optimalplacement=placement,
            planarquadric=False,
            planarweight=0.001,
            qualityweight=False,
            autoclean=True,
            selected=selected,
        )

    def select_bent(self, bent: np.ndarray, share: float) -> None:
        """Select the most curved faces.

        Args:
            bent: float64, the `bending` at the vertices of the source.
            share: The share of the surface area to select.
        """
        points, faces = self.result()
        bent = bent[kd_tree(self.source.vertices).query(points)[1]]
        order = np.argsort(-bent[faces].mean(axis=1))
        area = np.cumsum(trimesh.triangles.area(points[faces[order]]))
        last = order[np.searchsorted(area, share * area[-1])]
        self._set = self._lab.MeshSet()
        self._set.add_mesh(self._lab.Mesh(points, faces, v_scalar_array=bent))
        least = bent[faces[last]].mean()
        self._set.compute_selection_by_condition_per_face(condselect=f"(q0+q1+q2)/3 > {least}")

    def select_around(self, centres: np.ndarray, radius: float) -> None:
        """Select the faces whose centres lie within a radius of one of the points [K, 3]."""
        near = " || ".join(
            f"(((x0+x1+x2)/3-({x}))^2+((y0+y1+y2)/3-({y}))^2+((z0+z1+z2)/3-({z}))^2 < {radius**2})"
            for x, y, z in centres.tolist()
        )
        self._set.compute_selection_by_condition_per_face(condselect=near)

    def simplify_the_rest(self) -> None:
        """Simplify the faces that are not selected, to the number of vertices wanted."""
        self._set.apply_selection_inverse(invfaces=True, invverts=False)
        self.simplify(selected=True)

    def marching_cubes(self, cell: float, offset: float = 0.0) -> None:
        """Remesh by marching cubes, and discard all but the largest component.

        Args:
            cell: Edge length of the cubes.
            offset: How far outside the present surface the new one lies.

        Raises:
            MeshError: No surface is found at that size.
        """
        self._set.generate_resampled_uniform_mesh(
            cellsize=self._lab.PureValue(cell),
            offset=self._lab.PureValue(offset),
            mergeclosevert=False,
            discretize=False,
            multisample=False,
            absdist=False,
        )
        pieces = trimesh.Trimesh(*self.result(), process=False).split(only_watertight=False)
        if not len(pieces):
            raise MeshError(f"{self.source.name}: too thin for marching cubes of size {cell:.3g}")
        largest = max(pieces, key=lambda piece: len(piece.vertices))
        self._set = self._lab.MeshSet()
        self._set.add_mesh(self._lab.Mesh(largest.vertices, largest.faces))


def _remesh_finely(tool: Tool, rng: np.random.Generator) -> None:
    """Replace the tessellation of the source by a fine isotropic one."""
    tool.reset()
    tool.isotropic(rng.uniform(0.3, 0.4) * tool.edge, 4)


def _isotropic(tool: Tool, rng: np.random.Generator) -> None:
    """Edges of equal length."""
    _remesh_finely(tool, rng)
    tool.isotropic(tool.edge, 8)


def _adaptive(tool: Tool, rng: np.random.Generator) -> None:
    """Edges that are shorter where the surface is curved."""
    _remesh_finely(tool, rng)
    tool.isotropic(1.35 * tool.edge, 8)
    bent = bending(tool.source, tool.edge)
    for share, length in ((0.35, 0.85), (0.12, 0.55)):
        tool.select_bent(bent, share)
        tool.isotropic(length * tool.edge, 4, selected=True)
    tool.select_bent(bent, 0.35)
    tool.simplify_the_rest()


def _refined(tool: Tool, rng: np.random.Generator) -> None:
    """Edges that are shorter around four random vertices."""
    _remesh_finely(tool, rng)
    tool.isotropic(1.2 * tool.edge, 8)
    vertices, _ = tool.result()
    centres = vertices[rng.integers(len(vertices), size=4)]
    radius = 0.12 * np.sqrt(tool.area)
    tool.select_around(centres, radius)
    tool.isotropic(0.5 * tool.edge, 4, selected=True)
    tool.select_around(centres, radius)
    tool.simplify_the_rest()


def _simplified(tool: Tool, rng: np.random.Generator) -> None:
    """A fine mesh reduced by quadrics."""
    _remesh_finely(tool, rng)
    tool.isotropic(rng.uniform(0.8, 1.2) * tool.edge, 3)  # removes the old vertices
    tool.isotropic(rng.uniform(0.35, 0.45) * tool.edge, 3)
    tool.simplify(placement=True)


def _marching(tool: Tool, rng: np.random.Generator) -> None:
    """Marching cubes, with cells fitted to the number of vertices wanted."""
    cell = 1.1 * tool.edge
    for _ in range(4):
        tool.reset()
        tool.marching_cubes(cell * rng.uniform(0.99, 1.01))
        share = tool.count / tool.vertices
        if 1 <= share < 1.05:
            return
        cell *= np.sqrt(share) * 0.99


def _fused(tool: Tool, rng: np.random.Generator) -> None:
    """A morphological closing: the surface at a distance outside, and back to that inside it."""
    tool.reset()
    size = np.sqrt(tool.area)
    distance = size * rng.uniform(*FUSED)
    for offset in (distance, -distance):
        tool.marching_cubes(CELL * size, offset)
    tool.isotropic(rng.uniform(0.5, 0.6) * tool.edge, 3)  # removes the cubes
    tool.isotropic(tool.edge, 8)


POLICIES: dict[str, Policy] = {  # how a Tool gets about the number of vertices wanted
    "isotropic": _isotropic,
    "adaptive": _adaptive,
    "refined": _refined,
    "simplified": _simplified,
    "marching": _marching,
    "fused": _fused,
}
CLOSED = ("marching", "fused")  # need a closed surface: marching cubes invent one at a boundary
MIXTURES = {"mixed": list(POLICIES)[:5], "scans": list(POLICIES)}
