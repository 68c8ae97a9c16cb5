"""Geodesic polar patches agree with closed forms, log maps and a second implementation."""

from __future__ import annotations

import numpy as np
import potpourri3d
import pytest
import trimesh
from scipy.spatial import Delaunay

from meshspiral.data.datasets.bodies import Bodies
from meshspiral.geometry.connectivity import one_rings
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.patches import PatchTable, geodesic_patches
from tests.meshes import bow_tie, bumpy_sphere, lattice, punctured, torus, two_cones, union

TURN = 2 * np.pi
DISTANCES = np.arange(1, 6)[:, None] / 5  # of the five rings, in units of the radius
ANGLES = np.arange(16) * TURN / 16  # of the sixteen rays, from the first


def icosphere(subdivisions: int) -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Mesh(sphere.vertices, sphere.faces)


def scattered_square(count: int, seed: int) -> Mesh:
    """A Delaunay triangulation of random points in the unit square, facing +z.

    The first four vertices are the corners; the next forty lie on the sides.
    """
    rng = np.random.default_rng(seed)
    t, zero, one = rng.uniform(0.02, 0.98, (4, 10)), np.zeros(10), np.ones(10)
    sides = zip((t[0], one, t[2], zero), (zero, t[1], one, t[3]), strict=True)
    xy = np.concatenate(
        [
            [[0, 0], [1, 0], [1, 1], [0, 1]],
            *(np.stack(side, 1) for side in sides),
            rng.random((count, 2)),
        ]
    )
    faces = Delaunay(xy).simplices
    u, v = xy[faces[:, 1]] - xy[faces[:, 0]], xy[faces[:, 2]] - xy[faces[:, 0]]
    wrong = u[:, 0] * v[:, 1] < u[:, 1] * v[:, 0]
    faces[wrong] = faces[wrong, ::-1]
    return Mesh(np.column_stack([xy, np.zeros(len(xy))]), faces)


def single_triangle() -> Mesh:
    return Mesh([[0, 0, 0], [1, 0, 0], [0.3, 1.1, 0]], [[0, 1, 2]])


def tetrahedron() -> Mesh:
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1.2, 0], [0, 0, 1.4]]
    return Mesh(vertices, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def split_vertex(mesh: Mesh, v: int, begin: int = 0, end: int = 3) -> Mesh:
    """The mesh with a duplicate of v as its last vertex.

    The duplicate gets the faces of v from its begin-th to its end-th neighbour. Two zero-area faces
    between v and the duplicate close the gap.
    """
    neighbours, first = one_rings(mesh)
    ring = neighbours[first[v] : first[v + 1]][::-1].tolist()
    new, faces = len(mesh.vertices), mesh.faces.copy()
    for i in range(begin, end):
        face = np.flatnonzero([{v, ring[i], ring[i + 1]} == set(f) for f in faces.tolist()])
        faces[face] = np.where(faces[face] == v, new, faces[face])
    closing = [[new, v, ring[begin]], [v, new, ring[end]]]
    return Mesh(np.vstack([mesh.vertices, mesh.vertices[v]]), np.vstack([faces, closing]))


def filled_edge(mesh: Mesh, face: int) -> Mesh:
    """The mesh with one face halved by a new last vertex, in the middle of its first edge.

    Its neighbour is not halved: a zero-area face of three collinear points fills the gap.
    """
    a, b, c = mesh.faces[face]
    middle, new, faces = (mesh.vertices[a] + mesh.vertices[b]) / 2, len(mesh.vertices), mesh.faces
    faces = np.vstack([faces[:face], [[a, new, c]], faces[face + 1 :], [[new, b, c], [a, b, new]]])
    return Mesh(np.vstack([mesh.vertices, middle]), faces)


def shuffled(mesh: Mesh, seed: int) -> tuple[Mesh, np.ndarray]:
    """The surface with vertices and faces in random order, and the old number of each vertex."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(mesh.vertices))
    other = mesh.renumbered(order)
    return Mesh(other.vertices, rolled(other, seed).faces[rng.permutation(len(mesh.faces))]), order


def rolled(mesh: Mesh, seed: int) -> Mesh:
    """The mesh with the corners of every face rotated at random."""
    turn = np.random.default_rng(seed).integers(0, 3, (len(mesh.faces), 1))
    return Mesh(mesh.vertices, np.take_along_axis(mesh.faces, (turn + np.arange(3)) % 3, 1))


def body() -> Mesh:
    """A human body."""
    bodies = Bodies(vertices=1500)
    return bodies.load(bodies.names["train"][2]).mesh


CLOSED = {
    "icosphere": icosphere(2),
    "torus": torus(),
    "bumpy": bumpy_sphere(),
    "tetrahedron": tetrahedron(),
    "body": body(),
}
OPEN = {
    "lattice": lattice(7, 8),
    "square": scattered_square(60, 1),
    "holes": punctured(bumpy_sphere(1), 0.15),
    "rags": punctured(torus(), 0.45, seed=2),
    "bow tie": bow_tie(),
    "two cones": two_cones(),
    "triangle": single_triangle(),
    "parts": union(single_triangle(), tetrahedron(), bow_tie(), two_cones()),
}
every_closed_mesh = pytest.mark.parametrize("mesh", CLOSED.values(), ids=CLOSED)
every_open_mesh = pytest.mark.parametrize("mesh", OPEN.values(), ids=OPEN)
every_mesh = pytest.mark.parametrize("mesh", (CLOSED | OPEN).values(), ids=CLOSED | OPEN)


def size(mesh: Mesh) -> float:
    """The longest side of the bounding box."""
    return float(np.ptp(mesh.vertices, axis=0).max())


def sampled(values: np.ndarray, table: PatchTable) -> np.ndarray:
    """Values [V, N] at the samples, [V, rings, rays, N]; NaN at missing samples."""
    at = np.einsum("...k,...kn->...n", table.weights.astype(float), values[table.indices])
    return np.where(table.exists[..., None], at, np.nan)


def sample_points(mesh: Mesh, table: PatchTable) -> np.ndarray:
    """The coordinates of the samples, [V, rings, rays, 3]; NaN at missing samples."""
    return sampled(mesh.vertices, table)


def wrapped(angles: np.ndarray) -> np.ndarray:
    """The same angles, from -pi to pi."""
    return (angles + np.pi) % TURN - np.pi


def assert_sound(mesh: Mesh, table: PatchTable) -> None:
    """Check what holds for every table: a sample lies in a face, or it is missing."""
    indices, weights = table
    assert indices.min(initial=0) >= 0 and indices.max(initial=0) < len(mesh.vertices)
    assert np.isfinite(weights).all() and weights.min(initial=0) >= 0
    exists = (weights != 0).any(-1)
    np.testing.assert_array_equal(table.exists, exists)
    np.testing.assert_allclose(weights[exists].sum(-1), 1, rtol=0, atol=1e-5)
    assert (indices[~exists] == 0).all()
    assert not (exists[:, 1:] & ~exists[:, :-1]).any()  # a ray that left does not return
    number = len(mesh.vertices) ** np.arange(3)  # unique for each set of three vertices
    assert np.isin(np.sort(indices[exists], 1) @ number, np.sort(mesh.faces, 1) @ number).all()


# ------------------------------------------------------------------------------------- the plane


def flat_grid_angles(mesh: Mesh, table: PatchTable, radius: float, centers) -> np.ndarray:
    """The directions of the first rays of `centers`, on a mesh in the plane z = 0.

    Checks that all samples exist and form polar grids, counter-clockwise as seen from +z.
    """
    assert table.exists[centers].all()
    step = sample_points(mesh, table)[centers] - mesh.vertices[centers, None, None]
    distance, angle = np.hypot(step[..., 0], step[..., 1]), np.arctan2(step[..., 1], step[..., 0])
    assert np.abs(distance / (radius * DISTANCES) - 1).max() < 1e-4
    rays = np.arange(angle.shape[2]) * TURN / angle.shape[2]
    assert np.abs(wrapped(angle - angle[:, :1, :1] - rays)).max() < 1e-4
    return angle[:, 0, 0]


@pytest.mark.parametrize("radius", [0.01, 0.1, 0.3])
def test_on_an_irregular_flat_mesh_the_samples_are_a_polar_grid(radius):
    mesh = scattered_square(400, 0)
    xy = mesh.vertices[:, :2]
    inner = np.flatnonzero(np.minimum(xy, 1 - xy).min(1) > radius)
    assert len(inner) > 50
    angles = flat_grid_angles(mesh, geodesic_patches(mesh, radius), radius, inner)
    neighbours, first = one_rings(mesh)
    for v, zero in zip(inner, angles - TURN / 32, strict=True):
        x, y = (xy[neighbours[first[v] : first[v + 1]]] - xy[v]).T
        assert np.abs(wrapped(np.arctan2(y, x) - zero)).min() < 1e-4  # at some neighbour


@pytest.mark.parametrize("rays", [1, 2, 3, 6])
def test_a_ray_through_vertices_or_along_edges_stays_straight(rays):
    flat = mesh = lattice(15, 15)
    for v in [15 * i + j for i in (4, 6, 8, 10) for j in (3, 6, 9)]:
        mesh = split_vertex(mesh, v, v % 3, v % 3 + 3)  # two vertices at one point
    centers = [15 * i + j for i in (5, 7, 9) for j in (5, 6, 7, 8)]
    for radius in (0.7, 3.0):
        flat_grid_angles(flat, geodesic_patches(flat, radius, rays=rays), radius, centers)
        flat_grid_angles(mesh, geodesic_patches(mesh, radius, rays=rays), radius, centers)


def test_in_a_square_a_ray_ends_at_the_side_that_it_meets():
    mesh = scattered_square(100, 2)
    radius = 0.731
    table = geodesic_patches(mesh, radius)
    exists, points = table.exists, sample_points(mesh, table)
    ends = 0
    for v, ray in zip(*exists[:, 0].nonzero(), strict=True):
        step = points[v, 0, ray] - mesh.vertices[v]
        grid = mesh.vertices[v] + step / np.linalg.norm(step) * radius * DISTANCES
        inside = ((grid[:, :2] > 0) & (grid[:, :2] < 1)).all(1)
        assert inside.tolist() == exists[v, :, ray].tolist()
        ends += 0 < inside.sum() < 5
    assert ends > 500


def test_at_a_side_half_of_the_rays_have_samples_and_at_a_corner_a_quarter():
    mesh = scattered_square(100, 2)
    radius = 1e-3
    table = geodesic_patches(mesh, radius)
    exists, points = table.exists, sample_points(mesh, table)
    for v in range(4 + 40):
        rays, quarter = (4, v) if v < 4 else (8, (v - 4) // 10)
        assert exists[v, :, :rays].all() and not exists[v, :, rays:].any()
        # from the last edge clockwise: along the lower side, up the right side, ...
        angle = quarter * TURN / 4 + TURN / 32 + ANGLES[:rays]
        ray = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
        expected = mesh.vertices[v] + radius * DISTANCES[..., None] * ray
        np.testing.assert_allclose(points[v, :, :rays], expected, rtol=0, atol=1e-6)


def test_folding_a_flat_mesh_along_its_edges_changes_nothing():
    flat = lattice(8, 9)
    row = np.arange(8 * 9) // 9
    x, y, _ = flat.vertices.T
    folded = Mesh(
        np.stack([x, y * np.cos(0.9), row % 2 * np.sqrt(3) / 2 * np.sin(0.9)], 1), flat.faces
    )
    one, other = geodesic_patches(flat, 3.3), geodesic_patches(folded, 3.3)
    np.testing.assert_array_equal(one.indices, other.indices)
    np.testing.assert_allclose(one.weights, other.weights, rtol=0, atol=1e-5)
    assert 0.1 < one.exists.mean() < 0.9


# ------------------------------------------------------------------------------ curved surfaces


@pytest.mark.parametrize("radius", [0.05, 0.2, 0.5, 1.0, 2.0])
def test_on_a_sphere_the_rays_are_great_circles(radius):
    mesh = icosphere(3)
    center = mesh.vertices[:, None, None]
    points = sample_points(mesh, geodesic_patches(mesh, radius))
    upward = (points * center).sum(-1, keepdims=True)
    flat = points - upward * center
    distance = np.arctan2(np.linalg.norm(flat, axis=-1), upward[..., 0])
    error = np.abs(distance / (radius * DISTANCES) - 1)
    assert error.mean() < 0.003 and error.max() < 0.005
    zero = flat[:, :1, :1]
    left = np.cross(center, zero)
    angle = np.arctan2((flat * left).sum(-1), (flat * zero).sum(-1))
    error = np.abs(wrapped(angle - ANGLES))
    assert error.mean() < 0.015 * max(radius, 0.1)
    if radius < 0.1:  # within the vertex's own faces
        assert error.max() < 0.002


def log_map_errors(log: np.ndarray, table: PatchTable, radius: float, v: int) -> tuple:
    """The differences between the samples of v and its log map [V, 2], each [rings, rays].

    They are the difference in distance, in units of the radius, and in direction, up to the zero
    direction of the log map.
    """
    x, y = np.moveaxis(sampled(log, PatchTable(*(part[[v]] for part in table)))[0], -1, 0)
    turned = np.exp(1j * (np.arctan2(y, x) - ANGLES))
    return np.abs(np.hypot(x, y) / radius - DISTANCES), np.abs(np.angle(turned / turned.mean()))


@pytest.mark.parametrize("seed", [0, 3])
def test_on_a_curved_surface_the_samples_agree_with_the_log_map(seed):
    mesh = bumpy_sphere(seed, subdivisions=4)
    radius = 0.2 * np.sqrt(mesh.area)
    table = geodesic_patches(mesh, radius)
    solver = potpourri3d.MeshVectorHeatSolver(mesh.vertices, mesh.faces, 0.05)
    for v in (5, 50, 500, 1500, 2500):
        log = solver.compute_log_map(v, strategy="AffineLocal")
        distance, angle = log_map_errors(log, table, radius, v)
        assert distance.mean() < 0.003 and distance.max() < 0.01
        assert angle.mean() < 0.015 and angle.max() < 0.08


def test_on_a_flat_mesh_the_samples_agree_exactly_with_the_log_map():
    mesh = scattered_square(400, 0)
    table = geodesic_patches(mesh, 0.2)
    solver = potpourri3d.MeshVectorHeatSolver(mesh.vertices, mesh.faces, 0.05)
    inner = np.abs(mesh.vertices[:, :2] - 0.5).max(1) < 0.3
    for v in np.flatnonzero(inner)[::20]:
        log = solver.compute_log_map(v, strategy="AffineLocal")
        distance, angle = log_map_errors(log, table, 0.2, v)
        assert distance.max() < 1e-4 and angle.max() < 1e-4


# ---------------------------------------------------------- a second, literal implementation


def half_edges(mesh: Mesh) -> dict:
    """For every directed edge, three properties of the face on its left.

    They are the third vertex, the unit vector along the edge, and the unit vector in the plane of
    the face that points out of it across the edge.
    """
    out = {}
    for face, normal in zip(mesh.faces.tolist(), mesh.face_normals, strict=True):
        for i in range(3):
            a, b, c = face[i], face[i - 2], face[i - 1]
            along = mesh.vertices[b] - mesh.vertices[a]
            along = along / np.linalg.norm(along)
            out[a, b] = c, along, np.cross(along, normal / np.linalg.norm(normal))
    return out


def walk(mesh: Mesh, halves: dict, v: int, x: int, angle: float, distances) -> tuple:
    """Walk straight from v in space, at `angle` to the edge to x.

    At every edge the direction is rotated about the edge into the next face.

    Returns:
        The points at the distances, NaN beyond the boundary; and the smallest distance of the walk
        from a vertex.
    """
    points, done = np.full((len(distances), 3), np.nan), 0
    third, along, outward = halves[v, x]
    direction = np.cos(angle) * along - np.sin(angle) * outward
    position, walked, closest, ahead = mesh.vertices[v], 0.0, np.inf, [(x, third)]
    while True:
        exits = []
        for edge in ahead:
            speed = direction @ halves[edge][2]
            if speed > 0:
                away = (mesh.vertices[edge[0]] - position) @ halves[edge][2]
                exits.append((away / speed, edge))
        step, (a, b) = min(exits)
        while done < len(distances) and distances[done] <= walked + step:
            points[done] = position + (distances[done] - walked) * direction
            done += 1
        position, walked = position + step * direction, walked + step
        if done == len(distances):
            return points, closest
        closest = min(closest, *np.linalg.norm(mesh.vertices[[a, b]] - position, axis=1))
        if (b, a) not in halves:
            return points, closest
        _, along, outward = halves[a, b]
        third, _, inward = halves[b, a]
        direction = (direction @ along) * along - (direction @ outward) * inward
        ahead = [(a, third), (third, b)]


def walked_patches(mesh: Mesh, radius: float, rings: int, rays: int) -> tuple:
    """The samples, [V, rings, rays, 3], and whether each ray meets a vertex, bool [V, rays]."""
    halves = half_edges(mesh)
    neighbours, first = one_rings(mesh)
    points = np.full((len(mesh.vertices), rings, rays, 3), np.nan)
    doubtful = np.zeros((len(mesh.vertices), rays), bool)
    distances = np.arange(1, rings + 1) / rings * radius
    for v in range(len(mesh.vertices)):
        ring = neighbours[first[v] : first[v + 1]].tolist()
        sectors = []
        for x in reversed(ring):
            if (v, x) in halves:
                other = mesh.vertices[[x, halves[v, x][0]]] - mesh.vertices[v]
                dot = np.dot(*other) / np.prod(np.linalg.norm(other, axis=1))
                sectors.append((x, np.arccos(dot)))
        total = sum(angle for _, angle in sectors)
        scale = TURN / total if ring and len(sectors) == len(ring) else 1.0  # 1 at a boundary
        for ray in range(rays):
            direction = (ray + 0.5) * TURN / rays / scale
            for x, angle in sectors:
                if direction < angle:
                    points[v, :, ray], closest = walk(mesh, halves, v, x, direction, distances)
                    doubtful[v, ray] = closest < 1e-9
                    break
                direction -= angle
    return points, doubtful


WALKED = {
    "sphere": bumpy_sphere(5),
    "shuffled": shuffled(bumpy_sphere(5), 6)[0],
    "holes": punctured(bumpy_sphere(1), 0.15),
    "rags": punctured(bumpy_sphere(2), 0.45, seed=2),
    "cones": two_cones(),
}


@pytest.mark.parametrize("mesh", WALKED.values(), ids=WALKED)
@pytest.mark.parametrize("radius, rings, rays", [(0.3, 2, 7), (1.3, 5, 8)])
def test_a_walk_in_space_reaches_the_same_points(mesh, radius, rings, rays):
    points = sample_points(mesh, geodesic_patches(mesh, radius, rings, rays))
    expected, doubtful = walked_patches(mesh, radius, rings, rays)
    assert doubtful.mean() <= 0.01
    points, expected = (np.moveaxis(x, 1, 2)[~doubtful] for x in (points, expected))
    assert np.isfinite(expected).any()
    np.testing.assert_allclose(points, expected, rtol=0, atol=1e-6)  # NaN must agree


# --------------------------------------------------------------------------- missing samples


@every_closed_mesh
@pytest.mark.parametrize("radius", [0.02, 0.2, 1.0])
def test_on_a_closed_mesh_no_sample_is_missing(mesh, radius):
    table = geodesic_patches(mesh, radius * size(mesh))
    assert table.exists.all()
    assert_sound(mesh, table)


@every_open_mesh
@pytest.mark.parametrize("radius", [0.02, 0.2, 1.0])
def test_on_an_open_mesh_some_samples_are_missing(mesh, radius):
    table = geodesic_patches(mesh, radius * size(mesh))
    assert 0 < table.exists.mean() < 1
    assert_sound(mesh, table)


@every_mesh
def test_consecutive_samples_are_no_farther_apart_than_the_rings(mesh):
    radius = 0.4 * size(mesh)
    points = sample_points(mesh, geodesic_patches(mesh, radius))
    start = np.broadcast_to(mesh.vertices[:, None, None], points[:, :1].shape)
    steps = np.linalg.norm(np.diff(np.concatenate([start, points], 1), axis=1), axis=-1)
    longest = np.nanmax(steps) * 5 / radius
    assert 0.9 < longest < 1 + 1e-5


def test_every_vertex_of_a_triangle_has_the_rays_inside_its_corner():
    mesh = single_triangle()
    exists = geodesic_patches(mesh, 0.01).exists
    for v in range(3):
        b, c = mesh.vertices[[v - 2, v - 1]] - mesh.vertices[v]
        corner = np.arctan2(np.linalg.norm(np.cross(b, c)), b @ c)
        count = np.sum(corner > ANGLES + TURN / 32)
        assert exists[v, :, :count].all() and not exists[v, :, count:].any()


def rays_by_fan(mesh: Mesh, v: int, fans: list) -> tuple[list[int], list[float]]:
    """The number of rays of v that start in each fan (a set of vertices), and the fans' angles."""
    table = geodesic_patches(mesh, 1e-3)
    used = [set(row) - {v} for row in table.indices[v, 0][table.exists[v, 0]].tolist()]
    assert all(sum(row <= fan for fan in fans) == 1 for row in used)
    angles = []
    for fan in fans:
        around = [[x for x in face if x != v] for face in mesh.faces.tolist() if v in face]
        sides = [mesh.vertices[pair] - mesh.vertices[v] for pair in around if set(pair) <= fan]
        angles.append(sum(np.arctan2(np.linalg.norm(np.cross(b, c)), b @ c) for b, c in sides))
    return [sum(row <= fan for row in used) for fan in fans], angles


def test_at_a_bow_tie_the_angles_of_the_fans_add_up():
    counts, angles = rays_by_fan(bow_tie(), 0, [{1, 2}, {3, 4}])
    assert sum(counts) == np.sum(sum(angles) > ANGLES + TURN / 32)
    assert all(abs(n - a * 16 / TURN) < 1 for n, a in zip(counts, angles, strict=True))


@pytest.mark.parametrize("height", [0.3, 3.0])
def test_closed_fans_with_a_common_vertex_share_the_full_turn(height):
    cones = two_cones()
    mesh = Mesh(cones.vertices * [1, 1, height], cones.faces)
    counts, angles = rays_by_fan(mesh, 0, [set(range(1, 6)), set(range(6, 11))])
    assert sum(counts) == 16
    assert all(abs(n - 16 * a / sum(angles)) < 1 for n, a in zip(counts, angles, strict=True))


# ------------------------------------------------------------------------------ degenerate meshes


def degenerate_meshes() -> dict[str, Mesh]:
    sphere, rng = bumpy_sphere(subdivisions=1), np.random.default_rng(0)
    collapsed = sphere.vertices.copy()  # a vertex and its one-ring at one point
    collapsed[sphere.faces[(sphere.faces == 40).any(1)]] = sphere.vertices[40]
    return {
        "coincident neighbours": split_vertex(sphere, 40),
        "collinear points": filled_edge(sphere, 40),
        "collapsed faces": Mesh(collapsed, sphere.faces),
        "all in one point": Mesh(0 * sphere.vertices + 0.3, sphere.faces),
        "all in one line": Mesh(sphere.vertices * [1, 0, 0], sphere.faces),
        "few points": Mesh(rng.integers(0, 3, sphere.vertices.shape), sphere.faces),
        "triangle": single_triangle(),
        "isolated vertex": Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], [[0, 1, 2]]),
        "no faces": Mesh([[0, 0, 0], [1, 0, 0]], []),
    }


DEGENERATE = degenerate_meshes()
every_degenerate_mesh = pytest.mark.parametrize("mesh", DEGENERATE.values(), ids=DEGENERATE)


@every_degenerate_mesh
@pytest.mark.parametrize("radius", [1e-3, 0.3, 100.0])
def test_the_samples_of_a_degenerate_mesh_are_sound(mesh, radius):
    table = geodesic_patches(mesh, radius * max(size(mesh), 1.0))
    assert_sound(mesh, table)
    isolated = np.setdiff1d(np.arange(len(mesh.vertices)), mesh.faces)
    assert not table.exists[isolated].any()


@pytest.mark.parametrize("name", [name for name in CLOSED | OPEN if name != "body"])
def test_a_radius_of_a_hundred_mesh_sizes_is_accepted(name):
    mesh = (CLOSED | OPEN)[name]
    table = geodesic_patches(mesh, 100 * size(mesh), rings=200, rays=5)
    assert_sound(mesh, table)
    assert table.exists.any()
    if name in CLOSED:
        assert table.exists.all()


REFINED = {
    "coincident neighbours": (split_vertex(bumpy_sphere(1), 40), {40}),
    "collinear points": (filled_edge(bumpy_sphere(1), 40), set(bumpy_sphere(1).faces[40])),
}


@pytest.mark.parametrize("refined, changed", REFINED.values(), ids=REFINED)
def test_zero_area_faces_do_not_change_the_rays_through_them(refined, changed):
    original = bumpy_sphere(1)
    table = geodesic_patches(refined, 1.5)
    same = sorted(set(range(len(original.vertices))) - changed)
    crossed = (table.indices[same] == len(original.vertices)).any(-1)
    assert crossed.sum() > 20
    points, expected = (
        sample_points(refined, table),
        sample_points(original, geodesic_patches(original, 1.5)),
    )
    np.testing.assert_allclose(points[same], expected[same], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "splits", [[(0, 3)], [(0, 1)], [(1, 5)], [(0, 3), (0, 2)], [(0, 1), (0, 1)]], ids=str
)
def test_coincident_neighbours_all_have_samples_at_the_right_distances(splits):
    mesh, v = icosphere(3), 300
    for begin, end in splits:  # the last one has a face whose corners all coincide
        mesh = split_vertex(mesh, v, begin, end)
    table = geodesic_patches(mesh, 0.5)
    assert table.exists.all()
    coincident = (mesh.vertices == mesh.vertices[v]).all(1)
    assert coincident.sum() == 1 + len(splits)
    points = sample_points(mesh, table)[coincident]
    distance = np.arccos(points @ mesh.vertices[v] / np.linalg.norm(points, axis=-1))
    error = np.abs(distance / (0.5 * DISTANCES) - 1)
    assert error.mean() < 0.003 and error.max() < 0.005


@pytest.mark.parametrize("begin, end", [(0, 3), (1, 4), (2, 5)])
def test_two_coincident_neighbours_share_the_rays_of_one_vertex(begin, end):
    """Each has half of the faces; its rays continue into the other half."""
    mesh = split_vertex(lattice(9, 9), 40, begin, end)
    flat_grid_angles(mesh, geodesic_patches(mesh, 2.3), 2.3, [40, 81])


# -------------------------------------------------------------------------------- invariances

NUMBERED = {
    "sphere": bumpy_sphere(1),
    "holes": punctured(bumpy_sphere(1), 0.15),
    "rags": punctured(bumpy_sphere(2), 0.45, seed=2),
    "bow tie": bow_tie(),
    "square": scattered_square(60, 1),
}
every_numbered_mesh = pytest.mark.parametrize("mesh", NUMBERED.values(), ids=NUMBERED)


def assert_same_but_for_first_directions(mesh: Mesh, other: np.ndarray, radius: float) -> None:
    """Check sample points `other` of the same surface.

    At boundary vertices they are equal. The first direction of an inner vertex is arbitrary; where
    the first sample is equal, all of them are.
    """
    points = sample_points(mesh, geodesic_patches(mesh, radius))
    halves = half_edges(mesh)
    inner = np.ones(len(mesh.vertices), bool)
    inner[[v for edge in halves if edge[::-1] not in halves for v in edge]] = False
    alike = np.isclose(points[:, 0, 0], other[:, 0, 0], rtol=0, atol=1e-5).all(-1) | ~inner
    np.testing.assert_allclose(other[alike], points[alike], rtol=0, atol=1e-5)
    assert alike[inner].sum() >= inner.sum() // 20


@every_numbered_mesh
def test_the_numbering_of_vertices_and_faces_changes_first_directions_alone(mesh):
    other, order = shuffled(mesh, 4)
    points = sample_points(other, geodesic_patches(other, 0.7))[np.argsort(order)]
    assert_same_but_for_first_directions(mesh, points, 0.7)


@every_numbered_mesh
def test_the_first_corners_of_faces_change_first_directions_alone(mesh):
    other = rolled(mesh, 4)
    assert_same_but_for_first_directions(
        mesh, sample_points(other, geodesic_patches(other, 0.7)), 0.7
    )


@every_numbered_mesh
def test_renumbering_vertices_alone_renumbers_the_table(mesh):
    order = np.random.default_rng(3).permutation(len(mesh.vertices))
    one, other = geodesic_patches(mesh, 0.7), geodesic_patches(mesh.renumbered(order), 0.7)
    np.testing.assert_array_equal(other.weights, one.weights[order])
    indices = np.where(other.exists[..., None], order[other.indices], 0)
    np.testing.assert_array_equal(indices, one.indices[order])


@every_numbered_mesh
@pytest.mark.parametrize("scale", [1000.0, 1e-5])
def test_patches_are_invariant_to_the_unit_of_length(mesh, scale):
    one = geodesic_patches(mesh, 0.7)
    other = geodesic_patches(Mesh(mesh.vertices * scale, mesh.faces), 0.7 * scale)
    np.testing.assert_array_equal(one.indices, other.indices)
    np.testing.assert_allclose(one.weights, other.weights, rtol=0, atol=1e-6)


@every_numbered_mesh
def test_samples_move_with_the_mesh(mesh):
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    moved = Mesh(mesh.vertices @ turn.T + [10.0, -20.0, 30.0], mesh.faces)
    one = sample_points(mesh, geodesic_patches(mesh, 0.7)) @ turn.T + [10.0, -20.0, 30.0]
    other = sample_points(moved, geodesic_patches(moved, 0.7))
    np.testing.assert_allclose(other, one, rtol=0, atol=1e-5)


# ------------------------------------------------------------------------------------- arguments


def test_shapes_and_types_follow_the_arguments():
    mesh = lattice(4, 5)
    for table, grid in (
        (geodesic_patches(mesh, 1), (5, 16)),
        (geodesic_patches(mesh, 0.5, 3, 7), (3, 7)),
        (geodesic_patches(mesh, 0.5, rings=1, rays=1), (1, 1)),
    ):
        assert table.indices.shape == table.weights.shape == (20, *grid, 3)
        assert table.indices.dtype == np.int32 and table.weights.dtype == np.float32


@every_mesh
def test_finer_grids_contain_the_samples_of_coarser_ones(mesh):
    radius = 0.3 * size(mesh)
    points = sample_points(mesh, geodesic_patches(mesh, radius))
    finer = sample_points(mesh, geodesic_patches(mesh, radius, rings=10))
    np.testing.assert_allclose(finer[:, 1::2], points, rtol=0, atol=1e-5 * size(mesh))
    finer = sample_points(mesh, geodesic_patches(mesh, radius, rays=48))
    np.testing.assert_allclose(finer[:, :, 1::3], points, rtol=0, atol=1e-5 * size(mesh))


@pytest.mark.parametrize("radius", [0, -1, np.nan, np.inf])
def test_an_invalid_radius_is_rejected(radius):
    with pytest.raises(ValueError, match=f"radius must be positive and finite, got {radius}"):
        geodesic_patches(lattice(3, 3), radius)


@pytest.mark.parametrize("rings, rays", [(0, 16), (5, 0), (-1, 16), (5, -2)])
def test_a_grid_without_samples_is_rejected(rings, rays):
    with pytest.raises(ValueError, match=f"at least 1, got {rings} and {rays}"):
        geodesic_patches(lattice(3, 3), 1.0, rings, rays)


@pytest.mark.parametrize("mesh", [bumpy_sphere(), lattice(7, 8)], ids=["sphere", "lattice"])
def test_a_turn_by_whole_rays_shifts_the_rays(mesh):
    shifts = np.arange(len(mesh.vertices)) % 16
    offset = 1e-3  # so that no ray meets an edge of the lattice's boundary
    unturned, turned = (
        geodesic_patches(mesh, 0.5, turn=s * 2 * np.pi / 16 + offset) for s in (0 * shifts, shifts)
    )
    for v, shift in enumerate(shifts):
        indices, weights = (np.roll(part[v], -shift, axis=1) for part in unturned)
        np.testing.assert_array_equal(turned.indices[v], indices)
        np.testing.assert_allclose(turned.weights[v], weights, atol=1e-5)


def test_on_a_plane_a_turn_rotates_the_samples():
    mesh, v = lattice(9, 9), 40
    steps = [
        sample_points(mesh, geodesic_patches(mesh, 2.0, turn=np.full(81, turn)))[v]
        - mesh.vertices[v]
        for turn in (0.0, 0.3)
    ]
    cosine, sine = np.cos(0.3), np.sin(0.3)
    rotation = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    np.testing.assert_allclose(steps[1], steps[0] @ rotation.T, atol=1e-5)
