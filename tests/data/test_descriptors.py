"""Descriptors by name, side by side, and what each is invariant to."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch

from meshspiral.data.descriptors import Descriptor, Features
from meshspiral.data.descriptors.geovec import Geovec
from meshspiral.data.descriptors.hks import Hks
from meshspiral.data.descriptors.raw import Raw
from meshspiral.data.descriptors.shot import Shot
from meshspiral.data.descriptors.xyz import Xyz, random_rotation
from meshspiral.data.preprocessing import compute_task, descriptor_task
from meshspiral.data.settings import ShotSettings
from meshspiral.experiment.schema import ConfigError
from meshspiral.geometry.mesh import Mesh
from tests.geometry.test_sampling import split_faces
from tests.helpers import composed
from tests.meshes import bumpy_sphere, icosphere, lattice, union

RAW = Raw(Raw.Settings(radius=0.4, rings=2, rays=5, support=0.8))


def described(mesh: Mesh, descriptor: Descriptor) -> np.ndarray:
    return compute_task(descriptor_task(mesh, descriptor))["features"]


def moved(mesh: Mesh, scale: float = 7.0) -> Mesh:
    q, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    q *= np.sign(np.linalg.det(q))
    return Mesh(scale * mesh.vertices @ q.T + [30.0, -20, 5], mesh.faces)


def test_raw_geometry_is_invariant_to_rotation_translation_and_scale():
    mesh = bumpy_sphere(3, 3)
    ours, theirs = described(mesh, RAW), described(moved(mesh), RAW)
    assert ours.shape == (len(mesh.vertices), RAW.channels) and ours.dtype == np.float32
    same = np.abs(ours - theirs).max(axis=1) < 1e-3 * np.abs(ours).max()
    assert same.mean() > 0.99  # rounding flips an axis where its sides tie


def test_raw_geometry_sees_another_shape_and_a_mirrored_one():
    mesh = bumpy_sphere(3, 3)
    other = bumpy_sphere(4, 3)
    mirrored = Mesh(mesh.vertices * [1, 1, -1], mesh.faces[:, ::-1])
    for change in (other, mirrored):
        apart = np.abs(described(mesh, RAW) - described(change, RAW)).max(axis=1)
        assert (apart > 0.05 * np.abs(described(mesh, RAW)).max()).mean() > 0.9


def test_raw_geometry_of_a_plane_in_closed_form():
    mesh = lattice(25, 25)
    count = len(mesh.vertices)
    frames = np.tile(np.eye(3, dtype=np.float32), (count, 1, 1))
    raw = Raw(Raw.Settings(radius=3.0 / np.sqrt(mesh.area), rings=2, rays=4, support=1.0))
    row = raw.compute(mesh, frames)[12 * 25 + 12] * np.sqrt(544)
    places = row[:-3].reshape(2, 4, 8)
    angles = -np.arange(4) * np.pi / 2
    for i, length in enumerate((0.5, 1.0)):
        expected = length * np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
        np.testing.assert_allclose(places[i, :, :3], expected, atol=1e-5)
        np.testing.assert_allclose(places[i, :, 3:6], [[0, 0, 1]] * 4, atol=1e-5)
        np.testing.assert_allclose(places[i, :, 6], length, atol=1e-5)
        np.testing.assert_allclose(places[i, :, 7], np.pi / 2, atol=1e-5)
    np.testing.assert_allclose(row[-3:], [0, 0, 1], atol=1e-6)


def test_raw_geometry_is_undefined_without_a_frame():
    mesh = union(bumpy_sphere(), lattice(2, 2))
    raw = Raw(Raw.Settings(radius=0.4, rings=2, rays=5, support=0.1))
    result = compute_task(descriptor_task(mesh, raw))
    assert result["undefined"] >= 4 and not result["features"][-4:].any()


def test_positions_change_with_the_pose_of_the_mesh_and_not_with_its_unit():
    mesh, xyz = bumpy_sphere(), Xyz(Xyz.Settings(rotate=False))
    scaled = Mesh(5 * mesh.vertices + 3, mesh.faces)
    np.testing.assert_allclose(described(scaled, xyz), described(mesh, xyz), atol=1e-6)
    assert np.abs(described(moved(mesh), xyz) - described(mesh, xyz)).max() > 0.01


def test_random_rotations_are_rotations_and_move_a_direction_anywhere():
    generator = torch.Generator().manual_seed(0)
    rotations = torch.stack([random_rotation(generator) for _ in range(400)])
    identity = torch.eye(3, dtype=torch.float64).expand(400, 3, 3)
    torch.testing.assert_close(rotations @ rotations.mT, identity)
    assert torch.linalg.det(rotations).min() > 0.99
    assert rotations.mean(0).abs().max() < 0.1  # of uniform rotations it is 0


def test_positions_are_rotated_in_training_on_request_and_other_features_are_not():
    mesh = bumpy_sphere()
    for rotate in (False, True):
        features = Features((RAW, Xyz(Xyz.Settings(rotate=rotate))), 1.0)
        columns = np.concatenate([described(mesh, each) for each in features.descriptors], axis=1)
        found = features.drawn(torch.from_numpy(columns), torch.Generator().manual_seed(1)).numpy()
        np.testing.assert_array_equal(found[:, :-3], columns[:, :-3])
        assert np.allclose(found[:, -3:], columns[:, -3:]) == (not rotate)
        lengths = (np.linalg.norm(each[:, -3:], axis=1) for each in (found, columns))
        np.testing.assert_allclose(*lengths, rtol=1e-5)


HKS = Hks(Hks.Settings(times=8, eigenfunctions=40))


def test_heat_kernel_signatures_see_neither_motion_nor_unit_nor_reflection():
    mesh = bumpy_sphere(3, 3)
    mirrored = Mesh(mesh.vertices * [1, 1, -1], mesh.faces[:, ::-1])
    for other in (moved(mesh), mirrored):
        np.testing.assert_allclose(described(other, HKS), described(mesh, HKS), atol=1e-5)
    apart = np.abs(described(bumpy_sphere(4, 3), HKS) - described(mesh, HKS))
    assert apart.max() > 100 * 1e-5


def test_all_vertices_of_a_sphere_have_the_same_heat_kernel_signature():
    # with 36 = 1 + 3 + ... + 11 functions, whole eigenspaces
    hks = Hks(Hks.Settings(times=5, eigenfunctions=36))
    assert np.abs(described(icosphere(3), hks)).max() < 0.05 / np.sqrt(544)


def test_descriptors_stand_side_by_side():
    config = composed(["data.features=[shot,raw,xyz]", "data.raw.rays=4"])
    features = Features.of(config.data)
    assert [d.name for d in features.descriptors] == ["shot", "raw", "xyz"]
    assert features.channels == 544 + 8 * 3 * 4 + 3 + 3
    assert Features.of(composed([]).data).channels == 544


@pytest.mark.parametrize(
    "override, message",
    [
        (
            "data.features=shott",
            "must be one of geovec, hks, raw, shot, xyz, or a list, got shott",
        ),
        ("data.features=[]", "data.features must have at least 1 entry"),
        ("data.raw.rings=0", "data.raw.rings must be at least 1, got 0"),
        ("data.shot.bins=0", "data.shot.bins must be at least 1, got 0"),
    ],
)
def test_wrong_features_are_one_line(override, message):
    with pytest.raises(ConfigError, match=message.replace("[", "\\[")):
        composed([override])


def test_shot_by_area_changes_less_where_vertices_are_added():
    mesh = bumpy_sphere(4, 4)
    dense = split_faces(mesh, np.flatnonzero(mesh.vertices[mesh.faces].mean(1)[:, 0] > 0.2))
    distances = []
    for by_area in (False, True):
        shot = Shot(ShotSettings(radius=0.3, bins=6, by_area=by_area))
        ours, theirs = described(mesh, shot), described(dense, shot)[: len(mesh.vertices)]
        distances.append(np.median(np.linalg.norm(ours - theirs, axis=1)))
    assert distances[1] < 0.7 * distances[0]


def test_settings_with_descriptors_are_pickled(toy_overrides):
    """For processes of their own."""
    config = composed(toy_overrides)
    assert pickle.loads(pickle.dumps(config)) == config


def test_geovec_does_not_depend_on_the_unit_and_has_the_size_of_shot():
    settings = Geovec.Settings(channels=20, eigenfunctions=60, largest=750.0)
    geovec, mesh = Geovec(settings), bumpy_sphere(2, 3)
    found = described(mesh, geovec)
    np.testing.assert_allclose(described(moved(mesh), geovec), found, atol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), np.sqrt(20 / 544), rtol=1e-4)
