"""Matching: two meshes in, a map out, whatever they are like; and what the program writes."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from meshspiral.commands.match import main, named
from meshspiral.data.datasets.bodies import Bodies
from meshspiral.data.scans import open_scan, scan
from meshspiral.experiment.runs import BEST, RunError
from meshspiral.geometry.mesh import Mesh, MeshError
from meshspiral.matching.matcher import Labels, Matcher, nearest
from tests.commands.test_train import ROOT, die, run
from tests.conftest import toy_shapes
from tests.damage import damaged_file
from tests.experiment.test_cli import cli  # noqa: F401

TOYS = toy_shapes()
SOURCE, TARGET = TOYS["test/0.ply"], TOYS["test/1.ply"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory, toy_overrides):
    folder = tmp_path_factory.mktemp("trained")
    gcnn3 = [o for o in toy_overrides if not o.startswith("seq_len")]
    settings = ["model=gcnn3", "optim.epochs=30", "optim.lr=0.01", "data.shot.radius=0.5"]
    run(folder, [*gcnn3, *settings])
    return folder


@pytest.fixture(scope="module")
def matcher(trained):
    return Matcher.load(trained)


@pytest.fixture
def files(tmp_path):
    for name, mesh in (("a", SOURCE), ("b", TARGET)):
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / f"{name}.ply")
    return tmp_path


def scanned(mesh, **changes):
    arrays = {"vertices": mesh.vertices, "faces": mesh.faces} | changes
    return scan(arrays["vertices"], arrays["faces"], "a")


# ------------------------------------------------------------------------------ the map itself


def labels(points, confidence):
    points = np.array(points, dtype=float).reshape(-1, 1) * [1.0, 0.0, 0.0]
    template = np.where(np.isnan(points[:, 0]), -1, 7).astype(np.int32)
    return Labels(template, points, np.array(confidence, dtype=np.float32))


def test_the_network_that_comes_along_knows_bodies():
    shapes = Bodies(1500)
    mesh = shapes.load("s9_squat").mesh
    found = Matcher.load().label(scan(mesh.vertices, mesh.faces, "a"))
    assert (found.template == np.arange(1500)).mean() > 0.5


def test_the_map_goes_to_the_nearest_place_on_the_template():
    one, two = labels([0.1, 4.9, np.nan], [1, 1, 0]), labels([5.0, 0.0, np.nan, 1], [1, 1, 0, 1])
    assert nearest(one, two).tolist() == [1, 0, -1]


def test_of_several_at_one_place_the_most_confident_is_taken():
    assert nearest(labels([2], [1]), labels([2, 2, 2], [0.1, 0.9, 0.5])).tolist() == [1]


def test_without_any_place_there_is_no_match():
    nowhere = labels([np.nan, np.nan], [0, 0])
    assert nearest(labels([1, 2], [1, 1]), nowhere).tolist() == [-1, -1]
    assert nearest(nowhere, labels([1, 2], [1, 1])).tolist() == [-1, -1]


def test_a_trained_network_finds_most_of_the_map(matcher):
    match = matcher.match(scanned(SOURCE), scanned(TARGET))
    off = np.linalg.norm(TARGET.vertices[match.target] - TARGET.vertices, axis=1)
    assert np.median(off) < 0.15 * np.sqrt(TARGET.area)
    assert (match.source_labels.confidence > 0).all()
    assert (match.source_labels.confidence <= 1).all()


def test_unit_place_and_vertex_order_do_not_matter(matcher):
    found = matcher.label(scanned(SOURCE))
    larger = matcher.label(scanned(SOURCE, vertices=1024 * SOURCE.vertices))
    np.testing.assert_array_equal(larger.template, found.template)
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.6, 0.3]))[:3, :3]
    moved = matcher.label(scanned(SOURCE, vertices=SOURCE.vertices @ turn.T * 1000 + [1e4, 0, 5]))
    assert (moved.template == found.template).mean() > 0.8  # grids begin in other directions
    order = np.random.default_rng(0).permutation(len(SOURCE.vertices))
    other = SOURCE.renumbered(order)
    again = matcher.label(scanned(other))
    assert (again.template == found.template[order]).mean() > 0.8


def test_other_densities_are_brought_to_that_of_the_training(trained):
    dense = trimesh.Trimesh(SOURCE.vertices, SOURCE.faces).subdivide().subdivide()
    finer = scan(np.asarray(dense.vertices), np.asarray(dense.faces), "a")
    points = Matcher.load(trained).label(scanned(SOURCE)).points

    def off(**options):
        found = Matcher.load(trained, **options).label(finer)
        near = np.linalg.norm(dense.vertices[:, None] - SOURCE.vertices, axis=2).argmin(axis=1)
        return np.median(np.linalg.norm(found.points - points[near], axis=1))

    assert off() == off(resampled=True) < off(resampled=False)


def test_smoothing_lowers_the_error(trained):
    truth = TOYS["template.ply"].vertices

    def error(**options):
        found = Matcher.load(trained, **options).label(scanned(SOURCE))
        return np.linalg.norm(found.points - truth, axis=1).mean()

    assert error(smooth=True) < error()


def test_the_templates_unit_does_not_matter_to_smoothing(trained):
    found = []
    for scale in (1, 1000):
        matcher = Matcher.load(trained, smooth=True)
        template = matcher.template
        matcher.template = Mesh(scale * template.vertices, template.faces)
        found.append(matcher.label(scanned(SOURCE)).template)
    np.testing.assert_array_equal(*found)


def test_confidence_is_that_of_the_label_after_smoothing_too(trained):
    plain, smooth = (Matcher.load(trained, smooth=x).label(scanned(SOURCE)) for x in (False, True))
    same = plain.template == smooth.template
    assert 0 < same.mean() < 1
    np.testing.assert_allclose(smooth.confidence[same], plain.confidence[same], rtol=1e-4)
    assert (smooth.confidence[~same] <= plain.confidence[~same]).all()


def test_a_vertex_without_a_face_gets_no_match(matcher):
    vertices = np.concatenate([[[1e30, 0, 0]], SOURCE.vertices])
    found = matcher.label(scan(vertices, SOURCE.faces + 1, "a"))
    np.testing.assert_array_equal(found.template[1:], matcher.label(scanned(SOURCE)).template)
    assert found.template[0] == -1 and found.confidence[0] == 0


def test_a_checkpoint_is_all_that_a_run_needs(trained, tmp_path):
    alone = tmp_path / "run" / BEST
    alone.parent.mkdir(parents=True)
    alone.write_bytes((trained / BEST).read_bytes())
    np.testing.assert_array_equal(
        Matcher.load(tmp_path / "run").label(scanned(SOURCE)).template,
        Matcher.load(trained).label(scanned(SOURCE)).template,
    )


def test_a_malicious_checkpoint_runs_nothing(trained, tmp_path):
    class Malicious:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "owned"),)

    alone = tmp_path / "run" / BEST
    alone.parent.mkdir(parents=True)
    saved = torch.load(trained / BEST, weights_only=True)
    torch.save({**saved, "extra": Malicious()}, alone)
    with pytest.raises(RunError, match="damaged"):
        Matcher.load(tmp_path / "run")
    assert not (tmp_path / "owned").exists()


# ------------------------------------------------------------------------------- the program


def test_a_pair_is_matched_and_written(cli, trained, files):  # noqa: F811
    code, out, err = cli("source=a.ply", "target=b.ply", f"run={trained}", program=main)
    assert code == 0, err
    folder = files / "outputs/matches/a_to_b"
    expected = {"map.txt", "template.txt", "match.npz", "source.ply", "target.npz", "target.ply"}
    assert {path.name for path in folder.iterdir()} >= expected
    match = np.loadtxt(folder / "map.txt", dtype=int)
    with np.load(folder / "match.npz", allow_pickle=False) as file:
        np.testing.assert_array_equal(file["map"], match)
        np.testing.assert_array_equal(
            file["template"], np.loadtxt(folder / "template.txt", dtype=int)
        )
    source, target = (
        trimesh.load(folder / f"{x}.ply", process=False) for x in ("source", "target")
    )
    np.testing.assert_allclose(source.vertices, SOURCE.vertices, atol=1e-6)
    np.testing.assert_array_equal(source.visual.vertex_colors, target.visual.vertex_colors[match])
    assert "a.ply, 162 vertices; confidence" in out
    for name in ("correspondence.png", "confidence.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")


def test_an_attribute_is_carried_over(cli, trained, files):  # noqa: F811
    np.save(files / "x.npy", np.arange(162.0))
    common = ["source=a.ply", "target=b.ply", f"run={trained}", "picture=false", "output=out"]
    code, out, _ = cli(*common, "transfer=color", program=main)
    assert code == 1 and "its vertices have no color" in out
    code, _, err = cli(*common, "transfer=x.npy", program=main)
    assert code == 0, err
    match = np.loadtxt("out/map.txt", dtype=int)
    np.testing.assert_array_equal(np.load("out/transferred.npy"), match)
    uv = np.random.default_rng(0).random((162, 2))
    visual = trimesh.visual.TextureVisuals(uv=uv)
    trimesh.Trimesh(TARGET.vertices, TARGET.faces, visual=visual, process=False).export("b.glb")
    common[1] = "target=b.glb"
    assert cli(*common, "transfer=uv", program=main)[0] == 0
    carried = [
        line.split()[1:]
        for line in Path("out/transferred.obj").read_text().splitlines()
        if line.startswith("vt ")
    ]
    np.testing.assert_allclose(
        np.array(carried, float), uv[np.loadtxt("out/map.txt", dtype=int)], atol=1e-6
    )
    colors = np.random.default_rng(0).integers(256, size=(162, 4)).astype(np.uint8)
    trimesh.Trimesh(TARGET.vertices, TARGET.faces, vertex_colors=colors, process=False).export(
        "b.ply"
    )
    common[1] = "target=b.ply"
    assert cli(*common, "transfer=color", program=main)[0] == 0
    carried = trimesh.load("out/transferred.ply", process=False).visual.vertex_colors
    expected = colors[np.loadtxt("out/map.txt", dtype=int), :3]
    np.testing.assert_array_equal(carried[:, :3], expected)


def test_the_map_is_of_the_users_vertices_after_a_repair(cli, trained, files):  # noqa: F811
    vertices = np.concatenate([SOURCE.vertices, SOURCE.vertices[:5]])
    vertices[50] = np.nan
    faces = np.concatenate([SOURCE.faces, SOURCE.faces[:3], [[0, 162, 5]]])
    trimesh.Trimesh(vertices, faces, process=False).export("a.ply")
    common = ["source=a.ply", "target=b.ply", f"run={trained}", "picture=false", "output=out"]
    code, out, _ = cli(*common, program=main)
    assert code == 1 and "a.ply: 1 vertex with" in out and "repair=true mends" in out
    assert out.count("\n") == 1 and not Path("out").exists()
    code, out, err = cli(*common, "repair=true", program=main)
    assert code == 0, err
    match = np.loadtxt("out/map.txt", dtype=int)
    assert len(match) == 167 and (match == -1).sum() == 1 and match[50] == -1
    np.testing.assert_array_equal(match[162:], match[:5])
    assert "5 vertices joined with others" in out
    np.save("x.npy", np.arange(1, 163))
    assert cli(*common, "repair=true", "transfer=x.npy", program=main)[0] == 0
    np.testing.assert_array_equal(np.load("out/transferred.npy"), np.where(match < 0, 0, match + 1))


def test_what_a_repair_cut_open_is_drawn(cli, trained, files):  # noqa: F811
    """The first vertex is on no face; others were doubled."""
    vertices = np.concatenate([[[np.nan, 0, 0]], SOURCE.vertices, [[3, 3, 3]]])
    faces = np.concatenate(
        [SOURCE.faces + 1, [[SOURCE.faces[0, 0] + 1, SOURCE.faces[0, 1] + 1, 163]]]
    )
    trimesh.Trimesh(vertices, faces, process=False).export("a.ply")
    code, out, err = cli(
        "source=a.ply", f"run={trained}", "repair=true", "output=out", program=main
    )
    assert code == 0 and "cut open" in out, out + err
    assert Path("out/correspondence.png").exists()
    sources = ["sources=a.ply", f"run={trained}", "repair=true", "output=many", "workers=1"]
    code, out, _ = cli(*sources, program=main)
    assert code == 0 and "1 of them mended" in out
    assert "cut open" in Path("many/a/remarks.txt").read_text()
    code, out, _ = cli(*sources, "picture=true", program=main)
    assert code == 0 and Path("many/a/correspondence.png").exists()


def test_without_opengl_a_match_has_no_pictures(cli, trained, files, monkeypatch):  # noqa: F811
    monkeypatch.setattr("meshspiral.viz.render._render", die)
    Path("out").mkdir()
    Path("out/correspondence.png").touch()  # of another match, before
    code, out, err = cli("source=a.ply", f"run={trained}", "output=out", program=main)
    assert code == 0 and "no pictures: VTK could not draw" in out + err
    assert Path("out/template.txt").exists() and not list(Path("out").glob("*.png"))


def test_results_are_no_sources_and_are_not_overwritten_by_others(cli, trained, files):  # noqa: F811
    common = ["sources='**/*.ply'", f"run={trained}", "workers=1", "output=out"]
    assert cli(*common, program=main)[0] == 0
    code, out, _ = cli(*common, program=main)
    assert code == 0 and "2 of 2 are done already" in out
    Path("b.ply").rename("c.ply")
    code, out, _ = cli("source=c.ply", f"run={trained}", "output=out/b", program=main)
    assert code == 1 and "holds the match of" in out and "b.ply" in out


@pytest.mark.parametrize(
    "words, lost",
    [
        (["source=source.ply", "output=."], "source.ply"),
        (["source=b.ply", "target=target.ply", "output=."], "target.ply"),
        (["sources=b.ply", "target=out/target.ply", "output=out", "workers=1"], "out/target.ply"),
        (
            ["source=b.ply", "target=a.ply", "transfer=transferred.npy", "output=."],
            "transferred.npy",
        ),
    ],
)
def test_no_input_is_overwritten(cli, trained, files, words, lost):  # noqa: F811
    Path("out").mkdir()
    np.save("transferred.npy", np.zeros(162))
    if lost.endswith("ply"):
        Path("a.ply").rename(lost)
    before = Path(lost).read_bytes()
    code, out, err = cli(*words, f"run={trained}", "picture=false", program=main)
    assert code == 1 and f"{lost} would be overwritten; choose another" in out + err
    assert Path(lost).read_bytes() == before


def test_many_are_matched_and_those_done_are_skipped(cli, trained, files):  # noqa: F811
    (files / "scans").mkdir()
    for i in range(3):
        mesh = TOYS[f"test/{i}.ply"]
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(f"scans/{i}.ply")
    Path("scans/broken.ply").write_text("no mesh")
    Path("scans/notes.txt").write_text("no mesh either")
    common = ["sources='scans/*'", "target=b.ply", f"run={trained}", "output=out", "workers=1"]
    code, out, _ = cli(*common[:-1], "workers=2", program=main)
    assert code == 1 and "1 of 4 meshes were refused; out/refused.txt" in out
    assert "broken.ply: not a readable PLY" in Path("out/refused.txt").read_text()
    assert "3 meshes matched" in out
    assert "0 of them mended" in out
    files_of = sorted(p.name for p in Path("out/0").iterdir())
    assert files_of == ["map.txt", "match.npz", "remarks.txt", "source.ply", "template.txt"]
    assert Path("out/target.npz").exists() and Path("out/target.ply").exists()
    when = {i: os.stat(f"out/{i}/match.npz").st_mtime_ns for i in range(3)}
    Path("scans/broken.ply").unlink()
    Path("out/2/match.npz").write_bytes(b"half")
    code, out, _ = cli(*common, program=main)
    assert code == 0 and "2 of 3 are done already" in out and "1 meshes matched" in out
    assert not Path("out/refused.txt").exists()
    after = {i: os.stat(f"out/{i}/match.npz").st_mtime_ns for i in range(3)}
    assert [after[i] == when[i] for i in range(3)] == [True, True, False]
    code, out, _ = cli(*common, "smooth=true", program=main)  # another question
    assert code == 0 and "3 meshes matched" in out
    code, out, _ = cli(common[0], *common[2:], program=main)
    assert code == 0 and "3 meshes matched" in out and not Path("out/0/map.txt").exists()
    assert not Path("out/target.npz").exists()


def test_a_full_disk_ends_the_command(cli, trained, files, monkeypatch):  # noqa: F811
    """And loses nothing that was finished."""
    (files / "scans").mkdir()
    for i in range(3):
        mesh = TOYS[f"test/{i}.ply"]
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(f"scans/{i}.ply")
    common = ["sources='scans/*'", f"run={trained}", "output=out", "workers=1"]
    written = []

    def write(path, content):
        written.append(path)
        if len(written) > 5:  # of the second mesh
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return whole(path, content)

    whole = Path.write_bytes
    monkeypatch.setattr(Path, "write_bytes", write)
    code, out, err = cli(*common, program=main)
    assert code == 1 and "No space left on device" in out and "Traceback" not in out + err
    monkeypatch.setattr(Path, "write_bytes", whole)
    code, out, _ = cli(*common, program=main)
    assert code == 0 and "1 of 3 are done already" in out and "2 meshes matched" in out


def test_meshes_of_one_name_get_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("x/a.ply", "x/a.obj", "y/a.ply", "y/b.stl"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.touch()
    assert named("**/*", tmp_path / "out") == {
        "x_a.ply": "x/a.ply",
        "x_a.obj": "x/a.obj",
        "y_a": "y/a.ply",
        "y_b": "y/b.stl",
    }
    assert named("x/a.obj", tmp_path / "out") == {"a": "x/a.obj"}
    (tmp_path / "x_a.ply").touch()
    assert sorted(named("**/*a.ply", tmp_path / "y").values()) == ["x/a.ply", "x_a.ply"]


@pytest.mark.parametrize(
    "words, told",
    [
        ([], "give source=, a mesh, or sources="),
        (["source=a.ply", "sources=a.ply"], "give source=, a mesh, or sources="),
        (["sources="], "sources= is empty"),
        (["source=a.ply", "target="], "target= is empty"),
        (["source=none.ply"], "none.ply: No such file"),
        (["sources='none/*'"], "matches no mesh file"),
        (["source=a.ply", "transfer=color"], "give target="),
        (["source=a.ply", "run=nowhere"], "nowhere holds no checkpoints/best.ckpt"),
        (["source=a.ply", "colour=red"], "colour"),
        (["source=a.ply", "accelerator=tpu"], "accelerator must be one of"),
        (["source=a.ply", "target=none.obj"], "none.obj: No such file"),
    ],
)
def test_a_mistake_is_told_in_one_line(cli, trained, files, words, told):  # noqa: F811
    given = [*words, f"run={trained}"] if not any("run=" in word for word in words) else words
    code, out, err = cli(*given, program=main)
    assert code in (1, 2) and told in out + err and (out + err).count("\n") == 1, out + err


def test_a_killed_command_goes_on_where_it_was(cli, trained, files):  # noqa: F811
    (files / "scans").mkdir()
    for i in range(40):
        mesh = TOYS[f"test/{i % 3}.ply"]
        points = mesh.vertices + i
        trimesh.Trimesh(points, mesh.faces, process=False).export(files / f"scans/{i:02}.ply")
    command = [
        sys.executable,
        "-m",
        "src.match",
        f"sources='{files}/scans/*'",
        f"run={trained}",
        f"output={files}/out",
        "workers=1",
    ]
    process = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    until = time.monotonic() + 60
    while len(list(files.glob("out/*/match.npz"))) < 5 and time.monotonic() < until:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = len(list(files.glob("out/*/match.npz")))
    assert 5 <= done < 40
    code, out, err = cli(*command[3:], program=main)
    assert code == 0, err
    told = int(out.split(" of 40 are done already")[0].split()[-1])
    assert done - 1 <= told <= done  # at most the one in hand was lost
    for path in files.glob("out/*/match.npz"):
        with np.load(path, allow_pickle=False) as file:
            assert file["template"].shape == (162,)
    assert len(list(files.glob("out/*/match.npz"))) == 40


# -------------------------------------------------------------------------------- any damage


@pytest.fixture(scope="module")
def matchers(trained):
    """As it is, resampled, and smoothed."""
    options = ({"resampled": False}, {"resampled": True}, {"resampled": False, "smooth": True})
    return [Matcher.load(trained, **each) for each in options]


@given(seed=st.integers(0, 2**32), repair=st.booleans(), which=st.integers(0, 2))
@settings(
    max_examples=100,
    deadline=10_000,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
def test_a_damaged_file_gives_labels_or_one_line(matchers, tmp_path, seed, repair, which):
    suffix, data = damaged_file(SOURCE, seed)
    path = tmp_path / f"mesh{suffix}"
    path.write_bytes(data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            found = open_scan(path, repair)
            labels = matchers[which].label(found)
    except MeshError as error:
        assert str(path) in str(error) and "\n" not in str(error) and len(str(error)) < 600
        return
    known = found.place >= 0
    assert len(labels.template) == len(found.vertices)
    np.testing.assert_array_equal(labels.template >= 0, known)
    assert (labels.template < 162).all()
    assert np.isfinite(labels.points[known]).all() and np.isfinite(labels.confidence).all()
