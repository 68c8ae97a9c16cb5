"""SHOT agrees with the Point Cloud Library and with a literal implementation, and is invariant.

data/shot/*.npz hold meshes with the descriptors and local frames of PCL 1.13, which wraps cosine
votes: `sphere`, bumpy and closed; `grid`, open; `edge`, with sparse neighbours, duplicate points,
and normals that are NaN or zero.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.shot import _descriptors_and_frames, shot_descriptors

DATA = Path(__file__).parents[1] / "data" / "shot"


def reference(name):
    """The arrays of a reference file."""
    with np.load(DATA / f"{name}.npz") as file:
        return {key: file[key] for key in file.files}


def bumpy_sphere(subdivisions, seed):
    """A sphere without symmetries: vertices that are exact in float32, normals, and a radius."""
    rng = np.random.default_rng(seed)
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    wave = np.sin(sphere.vertices @ rng.normal(size=(3, 4)) * 3).sum(1, keepdims=True)
    noise = 0.12 / 2**subdivisions * rng.normal(size=sphere.vertices.shape)
    vertices = (sphere.vertices * (1 + 0.08 * wave) + noise).astype(np.float32)
    mesh = Mesh(vertices, sphere.faces)
    return mesh.vertices, mesh.vertex_normals, 1.5 / 2**subdivisions * np.sqrt(mesh.area)


def rotation(seed):
    """A random rotation matrix."""
    q = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return q * np.sign(np.linalg.det(q))


def changed(a, b):
    """The fraction of rows that differ by more than 1e-4; NaN must agree."""
    np.testing.assert_array_equal(np.isnan(a), np.isnan(b))
    return (np.nan_to_num(np.abs(a - b)).max(1) > 1e-4).mean()


@pytest.mark.parametrize("name", ["sphere", "grid", "edge"])
@pytest.mark.parametrize("bins", [10, 16])
def test_equals_pcl(name, bins):
    ref = reference(name)
    rows = shot_descriptors(ref["vertices"], ref["normals"], ref["radius"], bins, True)
    assert rows.dtype == np.float32
    # NaN must agree: the same rows are undefined
    np.testing.assert_allclose(rows, ref[f"shot{32 * (bins + 1)}"], rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", ["sphere", "grid", "edge"])
def test_local_frames_equal_pcl(name):
    ref = reference(name)
    frames = _descriptors_and_frames(ref["vertices"], ref["normals"], ref["radius"], 10, True)[1]
    np.testing.assert_allclose(frames, ref["lrf"], rtol=0, atol=1e-6)


def literal_shot(vertices, normals, radius, bins, wrap):
    """The algorithm rule by rule, one neighbour at a time, in float64 throughout."""
    rows = np.full((len(vertices), 32 * (bins + 1)), np.nan)
    for i, centre in enumerate(vertices):
        offsets = vertices - centre
        d = np.linalg.norm(offsets, axis=1)
        near = np.flatnonzero((d > 0) & (d < radius))
        near = near[np.argsort(d[near], kind="stable")]
        if len(near) < 5:
            continue
        v, w = offsets[near], radius - d[near]
        axes = np.linalg.eigh((w[:, None] * v).T @ v / w.sum())[1]
        x, z = (literal_sign(v, axes[:, c]) for c in (2, 0))
        frame = np.stack([x, np.cross(z, x), z])
        h = np.zeros((32, bins + 1))
        for k in near:
            literal_vote(h, frame @ offsets[k], d[k], normals[k] @ z, radius, bins, wrap)
        rows[i] = h.ravel() / np.linalg.norm(h)
    return rows


def literal_sign(v, axis):
    """The axis, or its opposite if most of the neighbours v lie there."""
    m, count = len(v), int((v @ axis >= 0).sum())
    if 2 * count == m:
        middle = v[m // 2 - 2 : m // 2 + 3]
        return axis if (middle @ axis > 0).sum() >= 3 else -axis
    return axis if 2 * count > m else -axis


def literal_vote(h, local, d, q, radius, bins, wrap):
    """Add the vote of a neighbour at local coordinates, distance d and cosine q to histogram h."""
    x, y, z = local
    b = (1 + np.clip(q, -1, 1)) * bins / 2
    s = int(np.floor(b + 0.5))
    f = b - s
    angle = np.arctan2(y, x)
    a = 0
    while angle > -np.pi + (a + 1) * np.pi / 4:
        a += 1
    out, up = d > radius / 2, z > 0
    V = 4 * a + 2 * out + up
    w = 1 - abs(f)
    if f > 0:
        h[V, (s + 1) % bins if wrap else s + 1] += f
    else:
        h[V, s - 1] += -f
    if out:
        e = (d - 3 * radius / 4) / (radius / 2)
        if d > 3 * radius / 4:
            w += 1 - e
        else:
            w += 1 + e
            h[V - 2, s] += -e
    else:
        e = (d - radius / 4) / (radius / 2)
        if d < radius / 4:
            w += 1 + e
        else:
            w += 1 - e
            h[V + 2, s] += e
    t = np.arccos(np.clip(z / d, -1, 1))
    if z <= 0:
        e = (t - 3 * np.pi / 4) / (np.pi / 2)
        if t > 3 * np.pi / 4:
            w += 1 - e
        else:
            w += 1 + e
            h[V + 1, s] += -e
    else:
        e = (t - np.pi / 4) / (np.pi / 2)
        if t < np.pi / 4:
            w += 1 + e
        else:
            w += 1 - e
            h[V - 1, s] += e
    if x != 0 or y != 0:
        e = np.clip((angle - (-7 * np.pi / 8 + a * np.pi / 4)) / (np.pi / 4), -0.5, 0.5)
        if e > 0:
            w += 1 - e
            h[(V + 4) % 32, s] += e
        else:
            w += 1 + e
            h[(V - 4) % 32, s] += -e
    h[V, s] += w


@pytest.mark.parametrize(("bins", "wrap"), [(16, False), (7, False), (10, True)])
def test_equals_a_literal_implementation(bins, wrap):
    vertices, normals, radius = bumpy_sphere(2, seed=0)
    rows = shot_descriptors(vertices, normals, radius, bins, wrap)
    assert changed(rows, literal_shot(vertices, normals, radius, bins, wrap)) == 0


@pytest.mark.parametrize("name", ["grid", "edge"])
def test_renumbering_permutes_the_rows(name):
    ref = reference(name)
    vertices, normals, radius = ref["vertices"], ref["normals"], ref["radius"]
    order = np.random.default_rng(0).permutation(len(vertices))
    rows = shot_descriptors(vertices, normals, radius)
    permuted = shot_descriptors(vertices[order], normals[order], radius)
    np.testing.assert_array_equal(permuted, rows[order])


def lattice():
    """Vertices at 300 points of an 8 x 8 x 8 lattice, with many equal distances, all exact."""
    rng = np.random.default_rng(0)
    vertices = np.argwhere(np.ones((8, 8, 8)))[rng.choice(512, 300, replace=False)].astype(float)
    normals = rng.normal(size=vertices.shape)
    return vertices, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_with_equal_distances_rows_do_not_depend_on_the_numbering():
    vertices, normals = lattice()
    rows = shot_descriptors(vertices, normals, 2.3)
    order = np.random.default_rng(1).permutation(len(vertices))
    permuted = shot_descriptors(vertices[order], normals[order], 2.3)
    np.testing.assert_array_equal(permuted, rows[order])


def test_a_point_at_the_radius_is_not_a_neighbour():
    vertices, normals = lattice()
    distance = np.linalg.norm(vertices - vertices[0], axis=1)
    assert (distance == 3).any()
    others = distance != 3
    without = shot_descriptors(vertices[others], normals[others], 3.0)
    rows = shot_descriptors(vertices, normals, 3.0)
    np.testing.assert_allclose(rows[0], without[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_rows_are_invariant_to_rigid_motion_but_not_to_reflection(seed):
    vertices, normals, radius = bumpy_sphere(4, seed)
    turn, shift = rotation(seed), np.array([0.5, -1, 2])
    rows = shot_descriptors(vertices, normals, radius)
    moved = shot_descriptors(vertices @ turn.T + shift, normals @ turn.T, radius)
    assert changed(rows, moved) < 0.01
    mirrored = shot_descriptors(vertices * [-1, 1, 1], normals * [-1, 1, 1], radius)
    assert changed(rows, mirrored) > 0.9


def test_rows_are_invariant_to_scale_with_the_radius():
    vertices, normals, radius = bumpy_sphere(4, seed=3)
    rows = shot_descriptors(vertices, normals, radius)
    doubled = shot_descriptors(2 * vertices, normals, 2 * radius)
    np.testing.assert_allclose(doubled, rows, rtol=0, atol=1e-6)  # exact: a factor of 2
    for factor in (1e-3, 174.1):
        scaled = shot_descriptors(factor * vertices, normals, factor * radius)
        assert changed(rows, scaled) < 0.01
    assert changed(rows, shot_descriptors(2 * vertices, normals, radius)) > 0.9


def test_defined_rows_are_non_negative_and_of_unit_norm():
    ref = reference("edge")
    rows = shot_descriptors(ref["vertices"], ref["normals"], ref["radius"])
    rows = rows[~np.isnan(rows).any(1)]
    assert len(rows) > 0
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, atol=1e-5)
    assert (rows >= 0).all()


def test_rows_of_vertices_with_too_few_neighbours_are_nan():
    ref = reference("edge")
    rows = shot_descriptors(ref["vertices"], ref["normals"], ref["radius"])
    few = ref["n_neighbors"] < 6  # the vertex itself is counted
    assert few.any()
    assert np.isnan(rows[few]).all()
    vertices, normals, radius = bumpy_sphere(2, seed=1)
    far = np.full((1, 3), 50.0)
    # seven vertices far away at one point are not neighbours of one another
    vertices, normals = np.vstack([vertices] + 7 * [far]), np.vstack([normals, normals[:7]])
    undefined = np.isnan(shot_descriptors(vertices, normals, radius)).all(1)
    np.testing.assert_array_equal(np.flatnonzero(undefined), np.arange(162, 169))


@pytest.mark.filterwarnings("error")  # casting NaN to a cell would warn, and be slow
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
def test_vertices_that_are_not_finite_count_as_absent(value):
    vertices, normals, radius = bumpy_sphere(2, seed=2)
    sound = np.arange(len(vertices)) % 7 != 3
    bad = vertices.copy()
    bad[~sound, 1] = value
    rows = shot_descriptors(bad, normals, radius)
    assert np.isnan(rows[~sound]).all()
    assert not np.isnan(rows[sound]).any()
    alone = shot_descriptors(vertices[sound], normals[sound], radius)
    np.testing.assert_allclose(rows[sound], alone, rtol=0, atol=1e-6)


def test_neighbours_without_a_finite_normal_cast_no_votes():
    vertices, normals, radius = bumpy_sphere(2, seed=2)
    rows = shot_descriptors(vertices, normals, radius)
    near = np.linalg.norm(vertices - vertices[0], axis=1) < radius
    own = normals.copy()
    own[0] = np.nan  # its own normal does not enter a vertex's row
    np.testing.assert_array_equal(shot_descriptors(vertices, own, radius)[0], rows[0])
    lost = normals.copy()
    lost[near, 2] = np.nan
    assert np.isnan(shot_descriptors(vertices, lost, radius)[0]).all()
    lost[np.flatnonzero(near)[-1]] = 0  # the only vote left has cosine 0: bin 8
    row = shot_descriptors(vertices, lost, radius)[0].reshape(32, 17)
    assert set(np.flatnonzero(row.any(0))) == {8}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("far", [1e30, -1e30, -1.2e7])
def test_a_far_vertex_changes_no_other_row(far):
    """The search grid has at most some millions of cells along an axis."""
    vertices, normals, radius = bumpy_sphere(2, seed=4)
    rows = shot_descriptors(vertices, normals, radius)
    vertices, normals = np.vstack([vertices, 3 * [far]]), np.vstack([normals, [0, 0, 1]])
    more = shot_descriptors(vertices, normals, radius)
    np.testing.assert_allclose(more[:-1], rows, rtol=0, atol=1e-6)
    assert np.isnan(more[-1]).all()


def test_pcl_wrap_moves_votes_between_the_last_bin_and_the_first():
    vertices, normals, radius = bumpy_sphere(3, seed=5)
    proper, wrapped = (
        shot_descriptors(vertices, normals, radius, 10, wrap).reshape(-1, 32, 11).astype(float)
        for wrap in (False, True)
    )
    # the other bins determine the scale of each row
    scale = [np.linalg.norm(h[..., 1:10], axis=(1, 2))[:, None, None] for h in (proper, wrapped)]
    proper, wrapped = proper / scale[0], wrapped / scale[1]
    np.testing.assert_allclose(proper[..., 1:10], wrapped[..., 1:10], atol=1e-5)
    moved = wrapped[..., 0] - proper[..., 0]
    assert (moved > -1e-5).all()
    assert (moved > 1e-2).any()
    np.testing.assert_allclose(proper[..., 10] - wrapped[..., 10], moved, atol=1e-5)


@pytest.mark.parametrize("bins", [1, 10, 16])
def test_no_vertices_give_no_rows(bins):
    empty = np.empty((0, 3))
    assert shot_descriptors(empty, empty, 1.0, bins).shape == (0, 32 * (bins + 1))


V = np.zeros((4, 3))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((V[:, :2], V[:, :2], 1.0), r"vertices must be \[V, 3\], got \(4, 2\)"),
        ((V[0], V[0], 1.0), r"vertices must be \[V, 3\], got \(3,\)"),
        ((V, V[:3], 1.0), r"normals must be \(4, 3\).*got \(3, 3\)"),
        ((V, V, 0.0), "radius must be positive and finite.*got 0.0"),
        ((V, V, -1.0), "radius must be positive and finite.*got -1.0"),
        ((V, V, np.nan), "radius must be positive and finite.*got nan"),
        ((V, V, np.inf), "radius must be positive and finite.*got inf"),
        ((V, V, 1e-30), "radius must be positive and finite.*got 1e-30"),
        ((V, V, 1e30), r"radius must be positive and finite.*got 1e\+30"),
        ((V, V, 1.0, 0), "bins must be an integer of at least 1, got 0"),
        ((V, V, 1.0, 2.5), "bins must be an integer of at least 1, got 2.5"),
    ],
)
def test_wrong_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        shot_descriptors(*arguments)
