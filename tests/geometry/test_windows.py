"""Polar coordinates are exact on flat surfaces, and windows follow the published formulae."""

from __future__ import annotations

import itertools
from time import process_time

import numpy as np
import pytest
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import Delaunay

from meshspiral.geometry.connectivity import one_rings
from meshspiral.geometry.faces import directed_edges
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.patches import face_sectors, geodesic_patches, left_corners
from meshspiral.geometry.windows import gaussian_windows, polar_coordinates
from tests.meshes import bow_tie, bumpy_sphere, lattice, punctured, random_meshes, torus

MESHES = random_meshes()
every_mesh = pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)


def plane(seed: int, stretch: float = 1.0, count: int = 250) -> Mesh:
    """An irregular mesh of the rectangle 1 x `stretch`, facing +z; if stretched, of needles."""
    rng = np.random.default_rng(seed)
    points = np.concatenate([rng.random((count, 2)), [[0, 0], [1, 0], [0, 1], [1, 1]]])
    faces = Delaunay(points).simplices
    a, b, c = (points[faces[:, i]] for i in range(3))
    clockwise = (b - a)[:, 0] * (c - a)[:, 1] < (b - a)[:, 1] * (c - a)[:, 0]
    faces[clockwise] = faces[clockwise, ::-1]
    return Mesh(np.pad(points * [1, stretch], ((0, 0), (0, 1))), faces)


def pyramid(heights: list[float], parts: int = 5) -> Mesh:
    """A cone or saddle: flat triangles around vertex 0, with base points on a circle at `heights`.

    Each triangle is cut into parts^2 faces, with uneven cuts. The angles at vertex 0 sum to less
    than 2 pi, or more.
    """
    n = len(heights)
    turn = 2 * np.pi * np.arange(n) / n + 0.2 * np.sin(np.arange(n))
    base = np.stack([np.cos(turn), np.sin(turn), heights], 1)
    number, faces = {(0, 0): 0}, []
    vertices = [np.zeros(3)]
    for level in range(1, parts + 1):
        for k in range(n * level):
            side, step = divmod(k, level)
            share = step / level
            point = (1 - share) * base[side] + share * base[(side + 1) % n]
            number[level, k] = len(vertices)
            vertices.append(point * (level / parts) ** 1.3)
    for level in range(parts):
        inner, outer = max(n * level, 1), n * (level + 1)
        for side in range(n):
            for step in range(level + 1):
                a = number[level, (side * level + step) % inner]
                o = side * (level + 1) + step
                b, c = number[level + 1, o], number[level + 1, (o + 1) % outer]
                faces.append([a, b, c])
                if step < level:
                    faces.append([a, c, number[level, (side * level + step + 1) % inner]])
    return Mesh(vertices, faces)


def polar(mesh: Mesh, v: int, radius: float):
    """Distance and angle of all vertices around v, [V] each; inf beyond the radius."""
    neighbours, first = one_rings(mesh)
    surface = mesh.vertices, neighbours, first, left_corners(mesh.faces, neighbours, first)
    count = len(mesh.vertices)
    distance, angle, disk = np.full(count, np.inf), np.zeros(count), np.zeros(count, np.int32)
    updates = np.zeros(count, np.int32)
    sectors = face_sectors(*surface)
    size = polar_coordinates(int(v), *surface, sectors, radius, distance, angle, updates, disk)
    assert sorted(disk[:size]) == np.flatnonzero(np.isfinite(distance)).tolist()
    assert not updates.any()
    return distance, angle


def zero_direction(mesh: Mesh, v: int) -> int:
    """The neighbour of v in direction 0: the last one clockwise."""
    neighbours, first = one_rings(mesh)
    return neighbours[first[v + 1] - 1]


def planar(mesh: Mesh, v: int):
    """Distance and angle of all vertices around v, [V] each, on a mesh in the plane z = 0."""
    x, y, _ = (mesh.vertices - mesh.vertices[v]).T
    angle = np.arctan2(y, x)
    return np.hypot(x, y), angle - angle[zero_direction(mesh, v)]


def largest_angle(a, b):
    """The largest angle between the directions a and b, in radians."""
    return np.abs((a - b + np.pi) % (2 * np.pi) - np.pi).max()


def dense(table, count: int) -> np.ndarray:
    """The rows of a table as a matrix, [V * rings * rays, V]."""
    out = np.zeros((len(table.first) - 1, count))
    rows = np.repeat(np.arange(len(out)), np.diff(table.first))
    np.add.at(out, (rows, table.indices), table.weights)
    return out


def assert_normalised(table, mesh: Mesh, rings: int = 5, rays: int = 16) -> None:
    """Every row of a vertex on a face has positive weights with sum 1; other rows are empty."""
    assert table.indices.dtype == np.int32 and table.weights.dtype == np.float32
    assert table.first.dtype == np.int64 and table.first[0] == 0
    assert table.first.shape == (len(mesh.vertices) * rings * rays + 1,)
    assert table.first[-1] == len(table.indices) == len(table.weights)
    assert (table.weights > 0).all()  # false for NaN
    used = np.isin(np.arange(len(mesh.vertices)), mesh.faces).repeat(rings * rays)
    np.testing.assert_array_equal(np.diff(table.first) > 0, used)
    sums = dense(table, len(mesh.vertices)).sum(1)
    np.testing.assert_allclose(sums, used, atol=1e-5)


# ------------------------------------------------------------------------------ polar coordinates


@pytest.mark.parametrize(
    "stretch, radius",
    [(1, 0.1), (1, 0.3), (1, 9), (30, 90)],
    ids=["small", "medium", "all", "needles"],
)
def test_on_a_plane_distances_and_angles_are_exact(stretch, radius):
    """Also from boundary vertices: in a rectangle every straight line stays inside."""
    mesh = plane(1, stretch)
    for v in range(0, len(mesh.vertices), 3):
        distance, angle = polar(mesh, v, radius)
        expected, expected_angle = planar(mesh, v)
        near = expected <= radius
        np.testing.assert_array_equal(np.isfinite(distance), near)
        np.testing.assert_allclose(distance[near], expected[near], rtol=1e-8)
        near[v] = False
        # the square root of the bound above
        assert largest_angle(angle[near], expected_angle[near]) < 1e-4


@pytest.mark.parametrize("heights", [[-0.8] * 5, [0.7, -0.7] * 3], ids=["cone", "saddle"])
def test_around_an_apex_angles_are_rescaled_to_a_full_turn(heights):
    mesh = pyramid(heights)
    distance, angle = polar(mesh, 0, 9.0)
    np.testing.assert_allclose(distance, np.linalg.norm(mesh.vertices, axis=1), rtol=1e-9)
    n = len(heights)
    corners = mesh.vertices[1 : n + 1]
    corners = corners / np.linalg.norm(corners, axis=1, keepdims=True)
    widths = np.arccos((corners * np.roll(corners, -1, 0)).sum(1))
    assert abs(widths.sum() - 2 * np.pi) > 0.5
    begins = np.cumsum(widths) - widths
    start = begins[zero_direction(mesh, 0) - 1]
    for u in range(1, len(mesh.vertices)):
        x = mesh.vertices[u] / np.linalg.norm(mesh.vertices[u])
        to = np.arccos(np.clip(corners @ x, -1, 1))
        side = np.argmin(np.abs(to + np.roll(to, -1) - widths))  # the side that contains x
        expected = (begins[side] + to[side] - start) * 2 * np.pi / widths.sum()
        assert largest_angle(angle[u], expected) < 1e-6


def test_behind_a_corner_of_half_a_turn_angles_are_exact():
    """Vertex 0 lies on the edge from 1 to 2; a face of zero area connects the three.

    Rounding makes its corner slightly more or less than half a turn, and the edge slightly too
    short or too long.
    """
    rng = np.random.default_rng(0)
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [2, 1, 4], [2, 4, 5]])
    for first in range(100):
        a, b, x, y = rng.uniform(0.5, 1, 4)
        vertices = [[0, 0, 0], [a, 0, 0], [-b, 0, 0], [x, -1, 0], [y, 1, 0], [-0.4, 1.5, 0]]
        mesh = Mesh(vertices, np.roll(faces, first, axis=0))
        distance, angle = polar(mesh, 0, 9.0)
        expected, expected_angle = planar(mesh, 0)
        np.testing.assert_allclose(distance, expected, rtol=1e-7)  # the square root of rounding
        assert largest_angle(angle[1:], expected_angle[1:]) < 1e-6


def test_on_a_sphere_distances_are_great_circles():
    sphere = trimesh.creation.icosphere(subdivisions=3)
    mesh = Mesh(sphere.vertices, sphere.faces)
    errors = []
    for v in range(0, len(mesh.vertices), 20):
        distance, _ = polar(mesh, v, 1.5)
        expected = np.arccos(np.clip(mesh.vertices @ mesh.vertices[v], -1, 1))
        near = np.isfinite(distance) & (np.arange(len(distance)) != v)
        errors.append(np.abs(distance[near] / expected[near] - 1))
    assert np.concatenate(errors).mean() < 0.01


def test_paths_lead_through_a_bow_tie():
    mesh = bow_tie()
    distance, angle = polar(mesh, 1, 9.0)
    to = np.linalg.norm(mesh.vertices, axis=1)
    np.testing.assert_allclose(distance[3:], to[1] + to[3:], rtol=1e-12)
    assert (angle[3:] == angle[0]).all()
    assert np.isinf(polar(mesh, 1, 0.99 * (to[1] + to[3:].min()))[0][3:]).all()


@every_mesh
def test_distances_are_between_the_straight_line_and_the_path_along_edges(mesh):
    """This holds on these meshes, which are not strongly folded."""
    start, tip = directed_edges(mesh.faces).T
    lengths = np.linalg.norm(mesh.vertices[start] - mesh.vertices[tip], axis=1)
    count = len(mesh.vertices)
    graph = coo_matrix((lengths, (start, tip)), (count, count)).tocsr()
    graph = graph.maximum(graph.T)
    for v in np.unique(mesh.faces)[::7]:
        distance, _ = polar(mesh, v, 1.5)
        straight = np.linalg.norm(mesh.vertices - mesh.vertices[v], axis=1)
        along = dijkstra(graph, indices=v)
        assert np.isfinite(distance[along <= 1.5]).all()
        near = np.isfinite(distance)
        assert (distance[near] <= along[near] * (1 + 1e-9)).all()
        assert (distance[near] >= straight[near] * (1 - 1e-9)).all()


# ---------------------------------------------------------------------------------------- windows


def literal_windows(mesh, v, radius, rings, rays, width=2.0) -> np.ndarray:
    """The rows of v in a planar mesh, [rings * rays, V], by the formulae of `gaussian_windows`."""
    r, t = planar(mesh, v)
    m = (np.arange(rings) + 0.5) * radius / rings
    ring = np.exp(-(((r[:, None] - m) / (width * radius / rings)) ** 2))
    ring[:, 0] = 1 / (1 + np.exp((r - m[0]) / (2 * m[0])))
    ring /= ring.sum(1, keepdims=True)
    ray = np.empty((len(r), rays))
    for u in range(len(r)):
        for j in range(rays):
            off = np.angle(np.exp(1j * (t[u] - (j + 0.5) * 2 * np.pi / rays)))
            d = r[u] * abs(np.sin(off)) if abs(off) < np.pi / 2 else r[u]
            ray[u, j] = np.exp(-((d / r[u]) ** 2) / 0.01) if r[u] > 0 else 1.0
    ray /= ray.sum(1, keepdims=True)
    area = np.zeros(len(r))
    for face in mesh.faces:
        a, b, c = mesh.vertices[face]
        area[face] += np.linalg.norm(np.cross(b - a, c - a)) / 2 / 3
    weights = np.einsum("u,ui,uj->iju", area * (r <= radius), ring, ray).reshape(-1, len(r))
    weights[weights < 0.01 * weights.max(1, keepdims=True)] = 0
    return weights / weights.sum(1, keepdims=True)


@pytest.mark.parametrize(
    "rings, rays, width", [(5, 16, 2.0), (3, 7, 2.0), (1, 1, 2.0), (3, 7, 0.2)]
)
def test_weights_follow_the_formulae(rings, rays, width):
    mesh = plane(2)
    table = dense(gaussian_windows(mesh, 0.25, rings, rays, width=width), len(mesh.vertices))
    for v in range(0, len(mesh.vertices), 30):
        rows = table[v * rings * rays : (v + 1) * rings * rays]
        expected = literal_windows(mesh, v, 0.25, rings, rays, width)
        assert ((rows > 0).sum(1) > 1).any()
        np.testing.assert_allclose(rows, expected, atol=1e-6)


@every_mesh
@pytest.mark.parametrize("radius", [1e-3, 0.5, 3.0, 100.0])
def test_every_row_is_normalised(mesh, radius):
    assert_normalised(gaussian_windows(mesh, radius), mesh)
    assert_normalised(gaussian_windows(mesh, radius, 2, 3), mesh, 2, 3)


def test_in_a_patch_of_one_vertex_that_vertex_has_weight_1():
    mesh = bumpy_sphere()
    table = gaussian_windows(mesh, 1e-3)
    np.testing.assert_array_equal(table.indices, np.repeat(np.arange(len(mesh.vertices)), 80))
    np.testing.assert_array_equal(table.weights, 1)


def test_rows_are_normalised_where_all_rings_but_a_far_one_vanish():
    """The last ring's exp(-10^4) underflows; a row of only this ring would be 0 / 0."""
    mesh = bumpy_sphere()
    assert_normalised(gaussian_windows(mesh, 1e-3, rings=200, rays=2), mesh, 200, 2)
    assert_normalised(gaussian_windows(mesh, 0.5, rings=200, rays=2), mesh, 200, 2)


def collapsed(mesh: Mesh, how: str) -> Mesh:
    """The mesh with damaged coordinates."""
    x = mesh.vertices.copy()
    if how == "edges":
        for a, b, _ in mesh.faces[::4]:
            x[a] = x[b]
    elif how == "onto a plane":
        x[:, 2] = 0
    elif how == "onto a line":
        x[:, :2] = 0
    elif how == "to a point":
        x[:] = 1
    elif how == "to coarse steps":
        x = np.round(2 * x) / 2
    elif how == "shuffled":
        x = x[np.random.default_rng(0).permutation(len(x))]
    return Mesh(x, mesh.faces)


@pytest.mark.parametrize(
    "how", ["edges", "onto a plane", "onto a line", "to a point", "to coarse steps", "shuffled"]
)
@every_mesh
def test_on_damaged_meshes_every_row_is_normalised(mesh, how):
    damaged = collapsed(mesh, how)
    for radius in (0.3, 2.0):
        assert_normalised(gaussian_windows(damaged, radius, 2, 5), damaged, 2, 5)


def test_propagation_ends_on_a_mesh_of_needles():
    """Takes 0.5 s; processing every correction of a distance would take 20 s."""
    mesh = punctured(bumpy_sphere(3, 3), 0.4)
    mesh = Mesh(mesh.vertices * [1e5, 1, 1], mesh.faces)
    polar(mesh, 0, 1.0)  # compile
    start = process_time()
    for v in range(0, len(mesh.vertices), 40):
        polar(mesh, v, 1e7)
    assert process_time() - start < 5


def test_in_a_patch_without_area_all_vertices_have_equal_weights():
    mesh = collapsed(bumpy_sphere(subdivisions=1), "to a point")
    rows = dense(gaussian_windows(mesh, 1.0), 42)
    # all vertices of the component are at distance 0
    np.testing.assert_allclose(rows, 1 / 42, rtol=1e-5)


def test_a_vertex_without_area_has_no_weight_next_to_others():
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [3, 0, 0]], [[0, 1, 2], [1, 3, 4]])
    rows = dense(gaussian_windows(mesh, 2.5), 5).reshape(5, 80, 5)
    assert (rows[1, :, 3:] == 0).all() and (rows[1].sum(1) > 0.99).all()
    assert (rows[4, :, 3:] == 0).all() and (rows[4].sum(1) > 0.99).all()


def test_windows_have_the_directions_of_the_rays():
    """The mean of a cell is nearest to the sample of its own ray, neither shifted nor mirrored."""
    mesh = bumpy_sphere(3, subdivisions=4)
    rays = 16
    patches = geodesic_patches(mesh, 0.3, 5, rays)
    windows = gaussian_windows(mesh, 0.3, 5, rays)
    for v in range(0, len(mesh.vertices), 50):
        samples = np.einsum("ijk,ijkx->ijx", patches.weights[v], mesh.vertices[patches.indices[v]])[
            3
        ]
        means = []
        for j in range(rays):
            s = (v * 5 + 3) * rays + j
            row = slice(windows.first[s], windows.first[s + 1])
            means.append(windows.weights[row] @ mesh.vertices[windows.indices[row]])
        distances = [
            np.linalg.norm(np.roll(np.array(means)[::sense], shift, 0) - samples, axis=1).mean()
            for sense in (1, -1)
            for shift in range(rays)
        ]
        assert np.argmin(distances) == 0


@every_mesh
def test_renumbering_the_vertices_renumbers_the_table(mesh):
    """The order of the faces is unchanged, and with it the first direction of every vertex."""
    order = np.random.default_rng(5).permutation(len(mesh.vertices))
    rows = dense(gaussian_windows(mesh, 0.9, 3, 8), len(order)).reshape(-1, 24, len(order))
    other = dense(gaussian_windows(mesh.renumbered(order), 0.9, 3, 8), len(order))
    other = other.reshape(rows.shape)
    np.testing.assert_allclose(other, rows[order][:, :, order], atol=1e-6)


@pytest.mark.parametrize(
    "mesh", [bumpy_sphere(1), punctured(bumpy_sphere(4, 3), 0.1)], ids=["closed", "open"]
)
def test_renumbering_the_faces_only_turns_patches(mesh):
    rng = np.random.default_rng(6)
    faces = mesh.faces[rng.permutation(len(mesh.faces))]
    other = Mesh(mesh.vertices, np.roll(faces, 1, axis=1))
    turned = 0
    for v in np.unique(mesh.faces)[::3]:
        (distance, angle), (distance_2, angle_2) = polar(mesh, v, 0.8), polar(other, v, 0.8)
        np.testing.assert_allclose(distance, distance_2, rtol=1e-9)
        near = np.isfinite(distance) & (np.arange(len(angle)) != v)
        if near.any():
            by = (angle_2 - angle)[near]
            assert largest_angle(by, by[0]) < 1e-6
            turned += largest_angle(by[0], 0) > 1e-3
    assert turned > 10


def test_windows_are_invariant_to_unit_and_rigid_motion():
    mesh = punctured(bumpy_sphere(2), 0.1)
    count = len(mesh.vertices)
    rotation = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    rows = dense(gaussian_windows(mesh, 0.8, 3, 8), count)
    moved = Mesh(mesh.vertices @ rotation.T + [3, -1, 2], mesh.faces)
    for other, radius in ((Mesh(mesh.vertices * 1000, mesh.faces), 800.0), (moved, 0.8)):
        other_rows = dense(gaussian_windows(other, radius, 3, 8), count)
        np.testing.assert_allclose(other_rows, rows, atol=1e-5)


def test_on_a_lattice_opposite_cells_are_opposite_and_outer_rings_farther_out():
    mesh = lattice(13, 13)
    v = 6 * 13 + 6
    rows = dense(gaussian_windows(mesh, 4.2, 4, 12), 169)[v * 48 : (v + 1) * 48]
    means = (rows @ (mesh.vertices - mesh.vertices[v])).reshape(4, 12, 3)
    np.testing.assert_allclose(means, -np.roll(means, 6, axis=1), atol=1e-5)
    lengths = np.linalg.norm(means, axis=2)
    assert (np.diff(lengths, axis=0) > 0).all()


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((0.0,), "radius must be positive and finite, got 0.0"),
        ((np.nan,), "got nan"),
        ((np.inf,), "got inf"),
        ((-1.0,), "got -1.0"),
        ((1.0, 0), "rings and rays must be at least 1, got 0 and 16"),
        ((1.0, 3, 0), "rings and rays must be at least 1, got 3 and 0"),
    ],
)
def test_invalid_arguments_are_rejected(arguments, message):
    with pytest.raises(ValueError, match=message):
        gaussian_windows(torus(), *arguments)


def test_a_mesh_without_faces_has_empty_rows():
    table = gaussian_windows(Mesh([[0, 0, 0], [1, 0, 0]], []), 1.0)
    assert len(table.indices) == len(table.weights) == 0
    assert table.first.tolist() == [0] * 161


def test_a_turn_by_whole_rays_shifts_the_rays():
    mesh = bumpy_sphere()
    shifts = np.arange(len(mesh.vertices)) % 16
    unturned = gaussian_windows(mesh, 0.6)
    turned = gaussian_windows(mesh, 0.6, turn=shifts * 2 * np.pi / 16)

    def row(table, v, ring, ray):
        s = (v * 5 + ring) * 16 + ray % 16
        out = np.zeros(len(mesh.vertices))
        entries = slice(table.first[s], table.first[s + 1])
        out[table.indices[entries]] = table.weights[entries]
        return out

    for v, ring, ray in itertools.product(range(0, 162, 9), range(5), range(0, 16, 3)):
        expected = row(unturned, v, ring, ray + shifts[v])
        np.testing.assert_allclose(row(turned, v, ring, ray), expected, atol=0.011)
