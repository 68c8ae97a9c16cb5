"""The bundled bodies have the documented properties."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from meshspiral.data.datasets.bodies import Bodies
from meshspiral.data.shapes import DataError
from meshspiral.geometry.mesh import Mesh

ROOT = Path(__file__).parents[2]
ASSETS = ROOT / "src" / "meshspiral" / "data" / "assets"
SIZES = {1500: 2996, 6890: 13776}


@pytest.fixture(scope="module", params=SIZES)
def bodies(request) -> Bodies:
    return Bodies(request.param)


def all_names(bodies: Bodies) -> list[str]:
    return [name for split in ("train", "val", "test") for name in bodies.names[split]]


def test_bodies_have_the_counts_and_faces_of_the_template(bodies):
    vertices = len(bodies.template.vertices)
    assert vertices in SIZES and len(bodies.template.faces) == SIZES[vertices]
    for name in all_names(bodies)[::23]:
        shape = bodies.load(name)
        assert shape.mesh.vertices.shape == (vertices, 3)
        assert np.array_equal(shape.mesh.faces, bodies.template.faces)
        assert shape.template_size == vertices
        assert np.array_equal(shape.labels, np.arange(vertices))


def test_shape_i_shows_subject_i_div_10_in_pose_i_mod_10(bodies):
    names = all_names(bodies)
    assert len(names) == len(set(names)) == 100
    assert names[0] == "s0_a_pose"
    subjects, poses = zip(*(name.split("_", 1) for name in names), strict=True)
    assert list(subjects) == [f"s{i // 10}" for i in range(100)]
    assert list(poses) == list(poses[:10]) * 10 and len(set(poses)) == 10


def test_split_is_70_10_20_and_no_subject_is_in_two_splits(bodies):
    assert [len(bodies.names[split]) for split in ("train", "val", "test")] == [70, 10, 20]
    subjects = {split: {n.split("_")[0] for n in names} for split, names in bodies.names.items()}
    assert subjects["train"] == {f"s{i}" for i in range(7)}
    assert subjects["val"] == {"s7"} and subjects["test"] == {"s8", "s9"}


def euler_characteristic(mesh: Mesh) -> int:
    edges = np.unique(np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0)
    return len(np.unique(mesh.faces)) - len(edges) + len(mesh.faces)


def components(mesh: Mesh) -> int:
    """The number of connected components."""
    smallest = np.arange(len(mesh.vertices))
    while True:
        spread = smallest.copy()
        for corner in range(3):
            np.minimum.at(spread, mesh.faces[:, corner], smallest[mesh.faces].min(1))
        if np.array_equal(spread, smallest):
            return len(np.unique(smallest))
        smallest = spread


def test_bodies_are_closed_manifolds_of_genus_0(bodies):
    """`Mesh` checks the winding and that edges have one or two faces; 3 F = 2 E implies two.

    All bodies have the connectivity of the template, and so its topology.
    """
    mesh = bodies.template
    edges = np.unique(np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0)
    assert 3 * len(mesh.faces) == 2 * len(edges)
    assert components(mesh) == 1
    for name in ["s0_a_pose", "s4_squat", "s9_lunge_reach"]:
        assert euler_characteristic(bodies.load(name).mesh) == 2


def test_rounding_left_no_degenerate_face_and_no_coincident_vertices(bodies):
    """Before rounding, the smallest face at 6890 vertices has an area of 1.31 mm^2."""
    for name in all_names(bodies):
        mesh = bodies.load(name).mesh
        areas = np.linalg.norm(mesh.face_normals, axis=1) / 2
        assert areas.min() > 1.2e-6
        assert len(set(map(tuple, mesh.vertices))) == len(mesh.vertices)


def test_faces_point_outwards_and_bodies_have_the_size_of_people(bodies):
    for name in ["template", *all_names(bodies)[::10]]:
        mesh = bodies.template if name == "template" else bodies.load(name).mesh
        centroid = mesh.vertices[mesh.faces].mean(1)
        litres = 1000 * (centroid * mesh.face_normals).sum() / 6
        assert 10 < litres < 150
        assert 0.8 < np.ptp(mesh.vertices[:, 2]) < 2.4
        left, right = mesh.vertices[:, 0].min(), mesh.vertices[:, 0].max()  # the hands in A-pose
        assert abs(left + right) < 0.05 < 0.3 < right


def test_both_sizes_show_the_same_bodies():
    coarse, fine = Bodies(1500), Bodies(6890)
    assert coarse.names == fine.names
    for name in all_names(coarse)[::9]:
        a, b = coarse.load(name).mesh, fine.load(name).mesh
        assert np.allclose(a.vertices.min(0), b.vertices.min(0), atol=0.01)
        assert np.allclose(a.vertices.max(0), b.vertices.max(0), atol=0.01)
        assert abs(a.area / b.area - 1) < 0.05


@pytest.mark.parametrize(("vertices", "limit"), [(1500, 1.0e6), (6890, 4.3e6)])
def test_files_are_small_and_finely_rounded(vertices, limit):
    path = ASSETS / f"bodies_{vertices}.npz"
    assert path.stat().st_size < limit
    with np.load(path, allow_pickle=False) as file:
        assert file["verts"].dtype == file["template"].dtype == file["faces"].dtype == np.uint16
        half_diagonal = np.linalg.norm(file["scale"]) / 2  # bound on the rounding error, in metres
    assert half_diagonal < 0.03e-3


def test_changing_a_loaded_body_does_not_change_the_data_set():
    bodies = Bodies()
    before = bodies.load("s0_squat").mesh.vertices.copy()
    bodies.load("s0_squat").mesh.vertices[:] = 0
    assert np.array_equal(bodies.load("s0_squat").mesh.vertices, before)


@pytest.mark.parametrize("vertices", [0, 5000, "many"])
def test_another_size_is_rejected_and_both_sizes_are_named(vertices):
    with pytest.raises(DataError, match=f"1500 or 6890, got {vertices!r}"):
        Bodies(vertices)


def test_an_unknown_name_is_rejected():
    with pytest.raises(DataError, match="'s10_a_pose'"):
        Bodies().load("s10_a_pose")


def test_the_source_of_the_bodies_is_credited():
    notice = (ROOT / "NOTICE").read_text()
    for credit in ["Anny", "NAVER", "Apache License, Version 2.0", "MakeHuman", "CC0"]:
        assert credit in notice
    for vertices in SIZES:
        assert f"src/meshspiral/data/assets/bodies_{vertices}.npz" in notice
    assert "MIT License" in (ROOT / "LICENSE").read_text()


@pytest.mark.parametrize(("name", "vertices"), [("bodies", 1500), ("bodies_6890", 6890)])
def test_the_configurations_name_the_two_sizes(name, vertices):
    config = yaml.safe_load((ROOT / f"conf/data/{name}.yaml").read_text())
    assert (config["name"], config["vertices"]) == ("bodies", vertices)
