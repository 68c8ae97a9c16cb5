"""Damage of training shapes: from the seed, with true labels, and known size."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.data.damaged import Damaged, bumpy, damaged, warped
from meshspiral.data.datasets.bodies import Bodies
from meshspiral.data.settings import DamageSettings
from meshspiral.data.shapes import Shape, SurfacePoints
from meshspiral.experiment.compose import compose_train
from meshspiral.experiment.schema import ConfigError
from tests.meshes import bumpy_sphere, icosphere, lattice, union

NONE = {
    "noise": 0.0,
    "warp": 0.0,
    "bumps": 0.0,
    "share": 1.0,
    "cut": 0.0,
    "holes": 0,
    "hole_radius": 0.1,
    "extremities": 0.0,
    "component": 0.0,
    "missing": 0.0,
}
BODIES = Bodies(1500)
BODY = BODIES.load("s0_a_pose")


def settings(**changes) -> DamageSettings:
    return DamageSettings(**NONE | {"size": 0.0, "seed": 0} | changes)


def apply(seed: int = 0, **changes) -> Shape:
    return damaged(BODY, settings(**changes), np.random.default_rng(seed))


def original_of(shape: Shape) -> np.ndarray:
    """The vertex of BODY of each vertex: the labels, since BODY is registered."""
    return shape.labels


def test_without_any_damage_the_shape_is_the_same():
    shape = apply()
    np.testing.assert_array_equal(shape.mesh.faces, BODY.mesh.faces)
    np.testing.assert_array_equal(shape.mesh.vertices, BODY.mesh.vertices)
    assert shape.mesh.size == pytest.approx(BODY.mesh.size, rel=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_a_cut_leaves_one_side_of_a_plane(seed):
    shape = apply(seed, cut=1.0)
    kept = original_of(shape)
    assert 0.25 <= len(kept) / 1500 <= 0.91
    np.testing.assert_array_equal(shape.mesh.vertices, BODY.mesh.vertices[kept])
    assert shape.mesh.size == pytest.approx(BODY.mesh.size, rel=1e-12)
    assert shape.mesh.area < 0.97 * BODY.mesh.area


def test_holes_larger_than_those_closed_stay():
    shape = apply(3, holes=3, hole_radius=0.3)
    assert len(original_of(shape)) < 1500 and shape.mesh.area < BODY.mesh.area


def test_an_extremity_is_cut_off():
    for seed in range(6):
        shape = apply(seed, extremities=1.0)
        left = shape.mesh.vertices
        lost = np.setdiff1d(np.arange(1500), original_of(shape))
        gone = BODY.mesh.vertices[lost]
        assert 10 < len(lost) < 400
        assert np.linalg.norm(np.ptp(gone, axis=0)) < 2 * np.sqrt(3) * 0.16 * BODY.mesh.size
        # it lay at an end of the body
        centre = BODY.mesh.vertices.mean(axis=0)
        outermost = np.linalg.norm(gone - centre, axis=1).max()
        assert outermost > np.quantile(np.linalg.norm(left - centre, axis=1), 0.8)


def test_a_component_is_removed():
    two = union(BODY.mesh, bumpy_sphere(), lattice(3, 3))
    labels = np.arange(len(two.vertices))
    both = Shape(two, labels, len(labels))
    for seed in range(4):
        rng = np.random.default_rng(seed)
        shape = damaged(both, settings(component=1.0), rng)
        lost = np.setdiff1d(labels, shape.labels)
        assert lost.tolist() in (list(range(1500, len(labels) - 9)), list(labels[-9:]))
    assert len(apply(0, component=1.0).labels) == 1500  # the only one stays


def test_missing_faces_are_closed_again_as_before_matching():
    shapes = [apply(seed, missing=0.3) for seed in range(4)]
    own = {tuple(sorted(face)) for face in BODY.mesh.faces.tolist()}
    changed = 0
    for shape in shapes:
        assert shape.mesh.area == pytest.approx(BODY.mesh.area, rel=0.02)
        found = original_of(shape)[shape.mesh.faces]
        changed += len({tuple(sorted(face)) for face in found.tolist()} - own)
    assert changed > 20  # holes of several faces get other faces


def test_noise_moves_vertices_by_its_deviation():
    moved = [
        np.std(apply(seed, noise=0.01).mesh.vertices - BODY.mesh.vertices) / BODY.mesh.size
        for seed in range(20)
    ]
    assert max(moved) <= 0.0101 and np.mean(moved) == pytest.approx(0.005, rel=0.4)


def test_a_warp_is_smooth_and_as_strong_as_its_amplitude():
    grid = np.random.default_rng(1).uniform(size=(2000, 3))
    step = 1e-4
    strains = []
    for seed in range(20):
        one, other = (
            warped(grid + shift, 0.02, 1.0, np.random.default_rng(seed))
            for shift in (0.0, np.array([step, 0, 0]))
        )
        lengths = np.linalg.norm(other - one, axis=1) / step
        assert lengths.min() > 0.3 and lengths.max() < 1.7  # nothing folds
        strains.append(np.std(lengths))
    assert 0.03 < np.mean(strains) < 0.15


def test_a_warped_shape_keeps_its_faces_and_labels():
    shape = apply(1, warp=0.02)
    np.testing.assert_array_equal(shape.labels, BODY.labels)
    moved = np.linalg.norm(shape.mesh.vertices - BODY.mesh.vertices, axis=1) / BODY.mesh.size
    assert moved.mean() > 1e-4 and moved.max() < 4 * 0.02 * 0.8
    assert len(shape.mesh.faces) == len(BODY.mesh.faces)


@pytest.mark.parametrize("slope", [0.1, 0.4])
def test_bumps_have_the_slope_asked_for_and_move_along_the_normals(slope):
    sphere = icosphere(5)
    slopes = []
    for seed in range(10):
        moved = bumpy(sphere, slope, np.random.default_rng(seed))
        heights = np.linalg.norm(moved, axis=1) - 1
        np.testing.assert_allclose(moved, (1 + heights)[:, None] * sphere.vertices, atol=1e-3)
        one, two = sphere.vertices[sphere.faces[:, 0]], sphere.vertices[sphere.faces[:, 1]]
        rise = heights[sphere.faces[:, 0]] - heights[sphere.faces[:, 1]]
        along_edge = rise / np.linalg.norm(one - two, axis=1)
        slopes.append(np.sqrt(2 * np.mean(along_edge**2)))  # of two directions
    assert np.mean(slopes) == pytest.approx(slope, rel=0.1)


def test_a_bumpy_shape_keeps_its_faces_and_labels():
    shape = apply(1, bumps=0.5)
    np.testing.assert_array_equal(shape.labels, BODY.labels)
    moved = np.linalg.norm(shape.mesh.vertices - BODY.mesh.vertices, axis=1) / BODY.mesh.size
    assert 1e-4 < moved.mean() < 0.01
    assert len(shape.mesh.faces) == len(BODY.mesh.faces)


def test_the_size_errs_by_at_most_its_share():
    sizes = [apply(seed, size=0.1).mesh.size / BODY.mesh.size for seed in range(20)]
    assert np.exp(-0.1) <= min(sizes) < 0.97 and 1.03 < max(sizes) <= np.exp(0.1)


def test_points_on_the_template_stay_with_their_vertices():
    points = SurfacePoints(np.tile(BODY.labels[:, None], 3), np.tile([1.0, 0, 0], (1500, 1)))
    shape = damaged(
        Shape(BODY.mesh, BODY.labels, 1500, points), settings(cut=1.0), np.random.default_rng(0)
    )
    np.testing.assert_array_equal(shape.points.corners[:, 0], shape.labels)


def test_training_shapes_alone_are_damaged_and_always_alike():
    shapes = Damaged(BODIES, settings(cut=1.0))
    train, test = shapes.names["train"][0], shapes.names["test"][0]
    assert len(shapes.load(test).labels) == 1500
    first, again = shapes.load(train), shapes.load(train)
    np.testing.assert_array_equal(first.mesh.vertices, again.mesh.vertices)
    other = Damaged(BODIES, settings(cut=1.0, seed=1)).load(train)
    assert len(other.labels) != len(first.labels) or (other.labels != first.labels).any()
    assert shapes.stamp(train) != Damaged(BODIES, settings(cut=0.5)).stamp(train)
    assert shapes.stamp(test) == BODIES.stamp(test)


def test_the_config_group():
    config = compose_train(["data/damage=scans", "data.damage.noise=0.001"])
    assert config.data.damage.noise == 0.001
    assert compose_train([]).data.damage is None
    with pytest.raises(ConfigError, match="damage"):
        compose_train(["data/damage=scans", "data.damage.share=2"])
