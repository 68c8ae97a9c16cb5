"""Remeshing: the surface stays, its tessellation changes, and closest points are correct."""

from __future__ import annotations

import builtins
import typing

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from meshspiral.data.settings import RemeshSettings
from meshspiral.geometry.barycentric import interpolate
from meshspiral.geometry.mesh import Mesh, MeshError
from meshspiral.geometry.remesh import (
    CLOSED,
    MIXTURES,
    POLICIES,
    Tool,
    bending,
    closest_points,
    remesh,
)
from tests.meshes import bumpy_sphere, lattice, two_boxes

SINGLE = list(POLICIES)


@pytest.fixture(scope="module")
def surface():
    return bumpy_sphere(1, subdivisions=3, bump=0.4)


def solid(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@pytest.mark.parametrize("policy", SINGLE)
def test_every_policy_remeshes_the_same_surface(surface, policy):
    made = remesh(surface, 400, policy, seed=2)
    mesh, shape = made.mesh, solid(made.mesh)
    assert 0.95 * 400 <= len(mesh.vertices) <= 400
    if policy != "marching":
        assert len(mesh.vertices) == 400
    assert shape.is_watertight and shape.is_winding_consistent
    assert shape.body_count == 1 and shape.euler_number == 2  # one closed piece of genus 0
    edge = shape.edges_unique_length.mean()
    assert made.distance.max() < (0.9 if policy == "marching" else 0.3) * edge
    _, _, back = closest_points(mesh, surface.vertices, surface.vertex_normals)
    assert back.max() < edge  # no part is lost
    point = interpolate(surface.vertices, surface.faces[made.faces], made.weights)
    np.testing.assert_allclose(
        np.linalg.norm(point - mesh.vertices, axis=1), made.distance, atol=1e-6
    )
    np.testing.assert_allclose(made.weights.sum(axis=1), 1)
    assert (made.weights >= 0).all()


def test_the_seed_determines_the_mesh(surface):
    one, same, other = (remesh(surface, 300, seed=seed).mesh for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.vertices, same.vertices)
    np.testing.assert_array_equal(one.faces, same.faces)
    assert one.faces.shape != other.faces.shape or (one.faces != other.faces).any()


def test_policies_differ_as_documented(surface):
    """In the spread of edge lengths and the shape of triangles."""
    made = {policy: solid(remesh(surface, 600, policy, seed=0).mesh) for policy in SINGLE}
    spread = {
        k: m.edges_unique_length.std() / m.edges_unique_length.mean() for k, m in made.items()
    }
    angle = {k: np.median(m.face_angles.min(axis=1)) for k, m in made.items()}
    slivers = {k: np.percentile(m.face_angles.min(axis=1), 5) for k, m in made.items()}
    uneven = set(SINGLE) - {"isotropic", "fused"}
    assert all(spread["isotropic"] < spread[k] for k in uneven)
    assert spread["refined"] > 1.5 * spread["isotropic"]
    assert angle["simplified"] < angle["isotropic"]
    assert slivers["marching"] < 0.5 * slivers["isotropic"]


@pytest.mark.parametrize("vertices", [200, 600])
def test_adaptive_edges_are_short_where_the_surface_is_curved(surface, vertices):
    """Compares mean edges at the most and the least curved quarter of the vertices."""

    def ratio(policy):
        mesh = remesh(surface, vertices, policy, seed=0).mesh
        shape = solid(mesh)
        ends = shape.edges_unique.ravel()
        length = np.bincount(ends, shape.edges_unique_length.repeat(2)) / np.bincount(ends)
        curved = bending(surface, 2 * length.mean())[
            cKDTree(surface.vertices).query(mesh.vertices)[1]
        ]
        least, most = np.quantile(curved, [0.25, 0.75])
        return length[curved >= most].mean() / length[curved <= least].mean()

    assert ratio("adaptive") < 0.6 < 0.8 < ratio("isotropic")


def test_bending_of_a_sphere_is_that_of_a_cap():
    ball = trimesh.creation.icosphere(4, radius=2.0)
    bent = bending(Mesh(ball.vertices, ball.faces), 0.6)
    np.testing.assert_allclose(bent, 0.15**2, rtol=0.1)
    assert bending(lattice(9, 9), 1.0).max() < 1e-12


@pytest.mark.parametrize("policy", SINGLE)
def test_tori_and_open_surfaces_get_the_size_wanted(policy):
    torus = trimesh.creation.torus(1, 0.4, major_sections=32, minor_sections=16)
    made = remesh(Mesh(torus.vertices, torus.faces), 300, policy, seed=1).mesh
    assert 285 <= len(made.vertices) <= 300 and solid(made).euler_number == 0
    hills = lattice(15, 15)
    heights = np.sin(hills.vertices[:, 0]) / 2
    hills = Mesh(hills.vertices + heights[:, None] * [0, 0, 1], hills.faces)
    if policy in CLOSED:
        with pytest.raises(MeshError, match=f"policy {policy} needs a closed surface"):
            remesh(hills, 100, policy)
        return
    made = remesh(hills, 100, policy, seed=1).mesh
    assert 90 <= len(made.vertices) <= 100 and not solid(made).is_watertight


@pytest.mark.parametrize("gap, joined", [(0.03, True), (0.08, False)])
def test_fused_fills_a_narrow_gap_and_leaves_a_wide_one(gap, joined, monkeypatch):
    """Of boxes that stay apart only one is left."""
    monkeypatch.setattr("meshspiral.geometry.remesh.FUSED", (0.02, 0.02))
    made = solid(remesh(two_boxes(gap), 800, "fused", seed=0).mesh)
    assert made.is_watertight and made.euler_number == 2
    assert made.extents[0] == pytest.approx(0.6 + gap if joined else 0.3, abs=0.01)


@pytest.mark.parametrize("mixture", MIXTURES)
def test_a_mixture_draws_each_of_its_policies(mixture, surface, monkeypatch):
    drawn = []
    for kind in SINGLE:
        monkeypatch.setitem(POLICIES, kind, lambda tool, rng, kind=kind: drawn.append(kind))
    for seed in range(30):
        remesh(surface, len(surface.vertices) - 2, mixture, seed)
    assert set(drawn) == set(SINGLE) - ({"fused"} if mixture == "mixed" else set())


def test_where_two_sheets_touch_the_closest_point_is_on_the_own_sheet():
    """In a flat box, 0.01 thick, the other side is nearer than many points of the own side."""
    box = trimesh.creation.box((1, 1, 0.01)).subdivide().subdivide().subdivide()
    box = Mesh(box.vertices, box.faces)
    flat = np.abs(box.vertices[:, 2]) > 0.004
    points = box.vertices.copy()
    points[:, 2] *= -0.2  # pushed through the box, nearer to the other side
    normals = np.zeros_like(points)
    normals[:, 2] = np.sign(box.vertices[:, 2])
    inner = (np.abs(box.vertices[:, :2]) < 0.4).all(axis=1) & flat
    face, weights, _ = closest_points(box, points[inner], normals[inner])
    reached = interpolate(box.vertices, box.faces[face], weights)
    np.testing.assert_allclose(reached, box.vertices[inner], atol=1e-9)


def test_closest_points_agree_with_exhaustive_search(surface):
    rng = np.random.default_rng(0)
    points = (
        surface.vertices[rng.integers(len(surface.vertices), size=60)]
        + rng.normal(size=(60, 3)) / 5
    )
    normals = rng.normal(size=(60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    face, weights, distance = closest_points(surface, points, normals)
    triangles = surface.vertices[surface.faces]
    unit = surface.face_normals / np.linalg.norm(surface.face_normals, axis=1, keepdims=True)
    for point, normal, found, weight, far in zip(
        points, normals, face, weights, distance, strict=True
    ):
        every = trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1)))
        each = np.linalg.norm(every - point, axis=1)
        each[unit @ normal < 0.2] = np.inf
        assert far == pytest.approx(each.min()) and each[found] == pytest.approx(far)
        np.testing.assert_allclose(weight @ triangles[found], every[found], atol=1e-9)


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_closest_points_do_not_depend_on_the_unit(surface, unit):
    rng = np.random.default_rng(0)
    points = surface.vertices[:100] + rng.normal(scale=0.02, size=(100, 3))
    anything = np.full_like(points, np.nan)
    face, weights, distance = closest_points(surface, points, anything)
    scaled = Mesh(unit * surface.vertices, surface.faces)
    found = closest_points(scaled, unit * points, anything)
    one, other = (
        interpolate(surface.vertices, surface.faces[f], w) for f, w in ((face, weights), found[:2])
    )
    np.testing.assert_allclose(other, one, atol=1e-9)
    np.testing.assert_allclose(found[2], unit * distance, rtol=1e-9)


def test_points_on_collinear_faces_have_coordinates_of_their_own():
    rng = np.random.default_rng(0)
    for _ in range(50):
        ends, share = rng.normal(size=(2, 3)), rng.permutation([0.0, rng.random(), 1.0])
        line = Mesh(ends[0] + share[:, None] * (ends[1] - ends[0]), [[0, 1, 2]])
        point = ends[0] + rng.random(1) * (ends[1] - ends[0])
        _, weights, distance = closest_points(line, point[None], np.full((1, 3), np.nan))
        np.testing.assert_allclose(weights[0] @ line.vertices, point, atol=1e-8)
        assert distance[0] < 1e-8 and weights.min() >= 0


def test_turned_marching_cubes_give_another_mesh_for_every_seed(surface):
    made = [remesh(surface, 300, "marching", seed, turned=True) for seed in (1, 2, 2)]
    first = [np.sort(each.mesh.vertices[:, 0]) for each in made]
    assert len(first[0]) != len(first[1]) or np.abs(first[0] - first[1]).max() > 1e-3
    np.testing.assert_array_equal(made[1].mesh.vertices, made[2].mesh.vertices)
    for each in made:
        assert each.distance.max() < 0.9 * solid(each.mesh).edges_unique_length.mean()


@pytest.mark.parametrize("mixture", MIXTURES)
def test_a_mixture_leaves_out_what_an_open_surface_cannot_have(mixture, monkeypatch):
    taken = set()
    for name in POLICIES:
        monkeypatch.setitem(POLICIES, name, lambda tool, rng, name=name: taken.add(name))
    for seed in range(40):
        remesh(lattice(6, 6), 30, mixture, seed)
    assert taken == {"isotropic", "adaptive", "refined", "simplified"}


def test_a_surface_without_area_is_refused():
    for faces in ([], [[0, 1, 2]]):
        with pytest.raises(MeshError, match="surface area must be above 0 to remesh it"):
            remesh(Mesh(np.zeros((3, 3)), faces), 12)


def test_without_an_agreeing_face_the_nearest_counts():
    plane = lattice(4, 4)
    up = plane.face_normals[0] / np.linalg.norm(plane.face_normals[0])
    face, weights, distance = closest_points(plane, plane.vertices[5:6] + up, -up[None])
    assert distance[0] == pytest.approx(1)
    np.testing.assert_allclose(weights[0] @ plane.vertices[plane.faces[face[0]]], plane.vertices[5])


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((300, "knitted"), "policy must be one of isotropic, adaptive, .*; got 'knitted'"),
        ((5, "isotropic"), "vertices must be at least 12, got 5"),
    ],
)
def test_wrong_arguments_are_refused(surface, arguments, message):
    with pytest.raises(MeshError, match=message):
        remesh(surface, *arguments)


def test_without_pymeshlab_the_error_says_how_to_install_it(surface, monkeypatch):
    real = builtins.__import__

    def without(name, *arguments, **options):
        if name == "pymeshlab":
            raise ImportError(name)
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MeshError, match="pip install pymeshlab"):
        Tool(surface, 100, np.random.default_rng(0))


def test_the_config_accepts_every_policy():
    assert typing.get_args(RemeshSettings.model_fields["policy"].annotation) == (
        *POLICIES,
        *MIXTURES,
    )
