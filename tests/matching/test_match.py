"""The command `match`: what it writes, what it transfers, and what it refuses."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from meshspiral.commands.match import main
from meshspiral.data.files import atomic_file
from meshspiral.experiment.schema import MatchConfig
from meshspiral.matching.batch import find_sources
from meshspiral.matching.job import NOT_IN_KEY, MatchJob
from meshspiral.matching.pair import match_file
from tests.conftest import toy_shapes
from tests.helpers import ROOT, VTK_CRASHES, start, wait_for

TOYS = toy_shapes()
SOURCE, TARGET = TOYS["test/0.ply"], TOYS["test/1.ply"]
CONFIG = dict.fromkeys(MatchConfig.model_fields) | {
    "smooth": False,
    "repair": False,
    "unflip": True,
    "accelerator": "cpu",
    "plugins": [],
}


def export(path, mesh):
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)


def ply_property(path, name):
    """A property of the vertices of a PLY file."""
    return trimesh.load(path, process=False).metadata["_ply_raw"]["vertex"]["data"][name]


@pytest.fixture
def files(tmp_path):
    """A folder with a source a.ply and a target b.ply."""
    export(tmp_path / "a.ply", SOURCE)
    export(tmp_path / "b.ply", TARGET)
    return tmp_path


@pytest.fixture
def scans(files):
    """A folder scans/ beside them, with the meshes 0.ply, 1.ply and 2.ply."""
    (files / "scans").mkdir()
    for i in range(3):
        export(files / f"scans/{i}.ply", TOYS[f"test/{i}.ply"])
    return files / "scans"


# ------------------------------------------------------------------------------------- one mesh


def test_a_pair_is_matched_and_written(cli, trained, files):
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
        trimesh.load(folder / f"{name}.ply", process=False) for name in ("source", "target")
    )
    with np.load(folder / "match.npz", allow_pickle=False) as file:
        confidence = file["map_confidence"]
        assert file["near_confidence"].shape == file["confidence"].shape == (162,)
    assert confidence.shape == (162,) and 0 <= confidence.min() < confidence.max() <= 1
    np.testing.assert_allclose(ply_property(folder / "source.ply", "confidence"), confidence)
    with np.load(folder / "target.npz", allow_pickle=False) as file:
        of_labels = ply_property(folder / "target.ply", "confidence")
        np.testing.assert_allclose(of_labels, file["near_confidence"])
    np.testing.assert_allclose(source.vertices, SOURCE.vertices, atol=1e-6)
    np.testing.assert_array_equal(source.visual.vertex_colors, target.visual.vertex_colors[match])
    assert "source: a.ply, 162 vertices; median map confidence" in out
    assert "target: b.ply, 162 vertices; median label confidence" in out
    for name in ("correspondence.png", "confidence.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")


def test_the_stages_of_a_match_are_reported(trained, files):
    settings = CONFIG | {"source": str(files / "a.ply"), "target": str(files / "b.ply")}
    settings |= {"run": str(trained), "smooth": True, "resample": True, "ensemble": True}
    job = MatchJob(MatchConfig(**settings), render=False)
    stages = []
    match_file(job, settings["source"], files / "out", lambda *stage: stages.append(stage))
    labelling = ["resampling", "descriptors", "neighbourhoods", "network", "ensemble", "refinement"]
    assert stages == [
        ("source", "reading"),
        ("target", "reading"),
        *(("target", stage) for stage in labelling),
        *(("source", stage) for stage in labelling),
        ("source", "writing"),
    ]
    stages.clear()  # the job keeps its target
    match_file(job, settings["source"], files / "out", lambda *stage: stages.append(stage))
    assert {role for role, _ in stages} == {"source"}


def test_the_bar_shows_the_stages(cli, trained, files, monkeypatch):
    monkeypatch.setattr("os.get_terminal_size", lambda *_: os.terminal_size((80, 24)))
    monkeypatch.setattr("meshspiral.data.progress.in_place", lambda stream: True)
    words = ["a.ply", "b.ply", f"run={trained}", "picture=false", "smooth=true"]
    _, _, err = cli(*words, program=main)
    shown = [line.rstrip() for line in re.split("[\r\n]", err) if "|" in line]
    names = list(dict.fromkeys(line.partition("|")[0][:24].strip() for line in shown))
    stages = ["descriptors", "neighbourhoods", "network", "refinement"]
    expected = [f"{role}: {stage}" for role in ("target", "source") for stage in stages]
    reading = ["source: reading", "target: reading"]
    assert [name for name in names if name] == [*reading, *expected, "source: writing"]
    counts = [int(re.search(r"(\d+)/17", line)[1]) for line in shown]
    # none is sized, resampled or copied
    assert list(dict.fromkeys(counts)) == [0, 1, 4, 5, 6, 8, 11, 12, 13, 15, 16]
    assert max(map(len, shown)) <= 80


def test_a_batch_shows_the_stages_of_its_target(cli, trained, scans, monkeypatch):
    monkeypatch.setattr("meshspiral.data.progress.in_place", lambda stream: True)
    words = ["sources=scans/*.ply", "target=b.ply", f"run={trained}", "output=out", "workers=1"]
    code, _, err = cli(*words, program=main)
    assert code == 0 and "target: neighbourhoods" in err


def test_an_attribute_is_transferred(cli, trained, files):
    np.save(files / "x.npy", np.arange(162))
    np.save(files / "y.npy", TARGET.vertices)
    common = ["source=a.ply", "target=b.ply", f"run={trained}", "picture=false", "output=out"]
    code, out, _ = cli(*common, "transfer=color", program=main)
    assert code == 1 and "its vertices have no color" in out
    code, _, err = cli(*common, "transfer=x.npy", program=main)
    assert code == 0, err
    match = np.loadtxt("out/map.txt", dtype=int)
    np.testing.assert_array_equal(np.load("out/transferred.npy"), match)  # whole numbers
    assert cli(*common, "transfer=y.npy", "export=dense", program=main)[0] == 0
    dense = np.load("out/dense.npz")
    inside = dense["corners"][:, 0] >= 0
    found = np.load("out/transferred.npy")
    np.testing.assert_allclose(found[inside], dense["points"][inside], atol=1e-6)
    assert inside.mean() > 0.5 and not np.allclose(found, TARGET.vertices[match], atol=1e-3)

    def expected(values):
        at = np.einsum("vk,vkx->vx", dense["weights"], values[dense["corners"]])
        return np.where(inside[:, None], at, values[match])

    uv = np.random.default_rng(0).random((162, 2))
    visual = trimesh.visual.TextureVisuals(uv=uv)
    trimesh.Trimesh(TARGET.vertices, TARGET.faces, visual=visual, process=False).export("b.glb")
    common[1] = "target=b.glb"
    assert cli(*common, "transfer=uv", program=main)[0] == 0
    transferred = [
        line.split()[1:]
        for line in Path("out/transferred.obj").read_text().splitlines()
        if line.startswith("vt ")
    ]
    np.testing.assert_allclose(np.array(transferred, float), expected(uv), atol=1e-5)
    colors = np.random.default_rng(0).integers(256, size=(162, 4)).astype(np.uint8)
    colored = trimesh.Trimesh(TARGET.vertices, TARGET.faces, vertex_colors=colors, process=False)
    colored.export("b.ply")
    common[1] = "target=b.ply"
    assert cli(*common, "transfer=color", program=main)[0] == 0
    transferred = trimesh.load("out/transferred.ply", process=False).visual.vertex_colors
    np.testing.assert_allclose(transferred[:, :3], expected(colors)[:, :3], atol=0.51)


def test_after_a_repair_the_map_is_of_the_users_vertices(cli, trained, files):
    vertices = np.concatenate([SOURCE.vertices, SOURCE.vertices[:5]])
    vertices[50] = np.nan
    faces = np.concatenate([SOURCE.faces, SOURCE.faces[:3], [[0, 162, 5]]])
    trimesh.Trimesh(vertices, faces, process=False).export("a.ply")
    common = ["source=a.ply", "target=b.ply", f"run={trained}", "picture=false", "output=out"]
    code, out, _ = cli(*common, program=main)
    assert code == 1 and "a.ply: 1 vertex with" in out and "repair=true fixes" in out
    assert out.count("\n") == 1 and not Path("out").exists()
    code, out, err = cli(*common, "repair=true", program=main)
    assert code == 0, err
    match = np.loadtxt("out/map.txt", dtype=int)
    assert len(match) == 167 and (match == -1).sum() == 1 and match[50] == -1
    np.testing.assert_array_equal(match[162:], match[:5])
    assert "repaired: 5 vertices" in out
    np.save("x.npy", np.arange(1, 163))
    assert cli(*common, "repair=true", "transfer=x.npy", program=main)[0] == 0
    np.testing.assert_array_equal(np.load("out/transferred.npy"), np.where(match < 0, 0, match + 1))


def test_a_mesh_that_a_repair_cut_open_is_rendered(cli, trained, files):
    """The first vertex is on no face; a repair duplicates others."""
    vertices = np.concatenate([[[np.nan, 0, 0]], SOURCE.vertices, [[3, 3, 3]]])
    a, b = SOURCE.faces[0, :2] + 1
    faces = np.concatenate([SOURCE.faces + 1, [[a, b, 163]]])
    trimesh.Trimesh(vertices, faces, process=False).export("a.ply")
    words = ["source=a.ply", f"run={trained}", "repair=true", "output=out"]
    code, out, err = cli(*words, program=main)
    assert code == 0 and "cut open" in out, out + err
    assert Path("out/correspondence.png").exists()
    sources = ["sources=a.ply", f"run={trained}", "repair=true", "output=many", "workers=1"]
    code, out, _ = cli(*sources, program=main)
    assert code == 0 and "1 repaired" in out
    assert "cut open" in Path("many/a/remarks.txt").read_text()
    assert 'src="../plotly.min.js"' in Path("many/a/view.html").read_text()
    assert Path("many/a/match_thumbnail.png").read_bytes().startswith(b"\x89PNG")
    assert Path("many/plotly.min.js").is_file()
    code, out, _ = cli(*sources, "picture=true", program=main)
    assert code == 0 and Path("many/a/correspondence.png").exists()
    code, out, _ = cli(*sources, "picture=false", program=main)
    assert code == 0 and not list(Path("many/a").glob("*.png"))
    assert not Path("many/a/view.html").exists()


def test_a_mesh_that_cannot_be_shown_is_matched_among_many(cli, trained, files, monkeypatch):
    def fails(*_):
        raise ValueError("nothing to align")

    monkeypatch.setattr("meshspiral.matching.viewer.align_to_template", fails)
    words = ["sources=a.ply", f"run={trained}", "output=many", "workers=1"]
    code, out, err = cli(*words, program=main)
    assert code == 0 and "a.ply: no view.html: nothing to align" in out + err
    assert Path("many/a/match.npz").exists() and not Path("many/a/view.html").exists()


def test_without_opengl_renders_are_skipped(cli, trained, files, monkeypatch):
    monkeypatch.setattr("meshspiral.viz.render.COMMAND", VTK_CRASHES)
    Path("out").mkdir()
    Path("out/correspondence.png").touch()  # of an earlier match
    code, out, err = cli("source=a.ply", f"run={trained}", "output=out", program=main)
    assert code == 0 and "skipping renders: VTK failed" in out + err
    assert Path("out/template.txt").exists() and not list(Path("out").glob("*.png"))


def test_two_workers_render(cli, trained, scans):
    words = ["sources=scans/*.ply", "target=b.ply", f"run={trained}", "output=out", "workers=2"]
    code, out, err = cli(*words, "picture=true", program=main)
    assert code == 0, out + err
    for i in range(3):
        for name in ("correspondence.png", "confidence.png"):
            assert (scans.parent / f"out/{i}/{name}").read_bytes().startswith(b"\x89PNG")


def test_a_mesh_whose_requested_render_failed_is_not_finished(cli, trained, scans, monkeypatch):
    words = ["sources=scans/0.ply", f"run={trained}", "output=out", "workers=1", "picture=true"]
    with monkeypatch.context() as broken:
        broken.setattr("meshspiral.viz.render.COMMAND", VTK_CRASHES)
        code, _, _ = cli(*words, program=main)
    assert code == 1 and "scans/0.ply: VTK failed" in Path("out/refused.txt").read_text()
    code, out, _ = cli(*words, program=main)
    assert code == 0 and "already matched" not in out
    assert Path("out/0/correspondence.png").is_file() and not Path("out/refused.txt").exists()


def test_a_folder_that_cannot_be_written_does_not_stop_the_others(cli, trained, scans):
    Path("out").mkdir()
    Path("out/1").touch()
    words = ["sources=scans", f"run={trained}", "output=out", "workers=2"]
    code, out, err = cli(*words, program=main)
    assert code == 1 and "Traceback" not in out + err
    [line] = Path("out/refused.txt").read_text().splitlines()
    assert line == "scans/1.ply: out/1: File exists"
    assert Path("out/0/match.npz").is_file() and Path("out/2/match.npz").is_file()


def test_a_symlink_loop_gives_each_file_once(scans, monkeypatch):
    monkeypatch.chdir(scans.parent)
    (scans / "loop").symlink_to(scans, target_is_directory=True)
    found = find_sources("scans/**/*.ply", Path("out"))
    assert found == {str(i): f"scans/{i}.ply" for i in range(3)}


def test_a_folder_means_all_meshes_in_it(cli, scans, monkeypatch):
    monkeypatch.chdir(scans.parent)
    assert list(find_sources("scans", Path("out"))) == ["0", "1", "2"]
    code, out, err = cli("source=scans", program=main)
    assert code == 1 and "source=scans is a folder; to match all meshes in it: sources=scans" in (
        out + err
    )


@pytest.mark.parametrize("name", ["...ply", "..ply", ".ply"])
def test_results_of_any_name_stay_in_their_folder(cli, trained, files, name):
    (files / "adv").mkdir()
    export(files / "adv/a.ply", SOURCE)
    (files / "adv/a.ply").rename(files / "adv" / name)
    word = f"source='adv/{name}'"
    code, out, err = cli(word, f"run={trained}", "picture=false", program=main)
    if code:  # a name without suffix is not a mesh file
        assert name == ".ply" and "format" in out + err
        return
    [folder] = (files / "outputs/matches").iterdir()
    assert (folder / "match.npz").is_file() and not list((files / "outputs").glob("*.npz"))


def test_two_files_are_source_and_target(cli, trained, files):
    code, _, err = cli("a.ply", "b.ply", f"run={trained}", "picture=false", program=main)
    assert code == 0, err
    assert (files / "outputs/matches/a_to_b/map.txt").is_file()


def test_a_target_shows_its_own_colours(cli, trained, files):
    """Colours by its own coordinates; by its labels, its errors would hide those of the map."""
    words = ["source=a.ply", "target=b.ply", f"run={trained}", "picture=false", "output=out"]
    assert cli(*words, program=main)[0] == 0
    target = trimesh.load("out/target.ply", process=False)
    x = TARGET.vertices
    expected = 0.1 + 0.9 * (x - x.min(axis=0)) / np.ptp(x, axis=0)
    shown = target.visual.vertex_colors[:, :3] / 255
    np.testing.assert_allclose(shown, expected, atol=0.01)


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
def test_no_input_is_overwritten(cli, trained, files, words, lost):
    Path("out").mkdir()
    np.save("transferred.npy", np.zeros(162))
    if lost.endswith("ply"):
        Path("a.ply").rename(lost)
    before = Path(lost).read_bytes()
    code, out, err = cli(*words, f"run={trained}", "picture=false", program=main)
    assert code == 1 and f"{lost} would be overwritten; choose another" in out + err
    assert Path(lost).read_bytes() == before


@pytest.mark.parametrize(
    "words, message",
    [
        ([], "give source=, a mesh, or sources="),
        (["source=a.ply", "sources=a.ply"], "give source=, a mesh, or sources="),
        (["sources="], "sources must not be empty"),
        (["source=a.ply", "target="], "target must not be empty"),
        (["source=none.ply"], "none.ply: No such file"),
        (["sources='none/*'"], "no mesh file (.ply, .obj, .off, .stl, .glb) matches 'none/*'"),
        (["source=a.ply", "transfer=color"], "give target="),
        (["source=a.ply", "scale=1", "height=2"], "give scale=1 or height=2, not both"),
        (["source=a.ply", "run=nowhere"], "nowhere has no checkpoints/best.ckpt"),
        (["source=a.ply", "colour=red"], "colour"),
        (["source=a.ply", "accelerator=tpu"], "accelerator must be one of cpu, gpu, got tpu"),
        (["source=a.ply", "target=none.obj"], "none.obj: No such file"),
    ],
)
def test_a_mistake_gives_one_message(cli, trained, files, words, message):
    given = [*words, f"run={trained}"] if not any("run=" in word for word in words) else words
    code, out, err = cli(*given, program=main)
    assert code in (1, 2) and message in out + err and (out + err).count("\n") == 1, out + err


# ----------------------------------------------------------------------------------- many meshes


def test_many_are_matched_and_finished_ones_are_skipped(cli, trained, scans):
    (scans / "broken.ply").write_text("no mesh")
    (scans / "notes.txt").write_text("no mesh file")
    common = ["sources='scans/*'", "target=b.ply", f"run={trained}", "output=out", "workers=1"]
    code, out, _ = cli(*common[:-1], "workers=2", program=main)
    assert code == 1 and "1 of 4 meshes were refused; out/refused.txt" in out
    assert "broken.ply: not a readable PLY" in Path("out/refused.txt").read_text()
    assert "3 meshes matched" in out and "(0 repaired, see remarks.txt), 1 refused" in out
    written = sorted(path.name for path in Path("out/0").iterdir())
    files = ["map.txt", "match.npz", "match_thumbnail.png", "remarks.txt", "source.ply"]
    assert written == [*files, "template.txt", "view.html"]
    assert Path("out/target.npz").exists() and Path("out/target.ply").exists()

    before = {i: os.stat(f"out/{i}/match.npz").st_mtime_ns for i in range(3)}
    (scans / "broken.ply").unlink()
    Path("out/2/match.npz").write_bytes(b"half")
    code, out, _ = cli(*common, program=main)
    assert code == 0 and "2 of 3 meshes are already matched" in out and "1 meshes matched" in out
    assert not Path("out/refused.txt").exists()
    after = {i: os.stat(f"out/{i}/match.npz").st_mtime_ns for i in range(3)}
    assert [after[i] == before[i] for i in range(3)] == [True, True, False]

    code, out, _ = cli(*common, "unflip=false", program=main)  # other settings: all anew
    assert code == 0 and "3 meshes matched" in out
    code, out, _ = cli(common[0], *common[2:], program=main)  # no target
    assert code == 0 and "3 meshes matched" in out and not Path("out/0/map.txt").exists()
    assert not Path("out/target.npz").exists()


def test_every_setting_that_changes_a_match_is_part_of_its_key(trained, files, monkeypatch):
    monkeypatch.chdir(files)
    config = {**CONFIG, "source": "a.ply", "target": "b.ply", "run": str(trained)}
    others = {
        "repair": True,
        "resample": True,
        "refine": "crf",
        "smooth": True,
        "unflip": False,
        "ensemble": True,
        "scale": 0.001,
        "height": 1.7,
        "transfer": "color",
        "export": ["dense"],
    }
    assert MatchConfig.model_fields.keys() == NOT_IN_KEY | others.keys()
    changes = [{}, *({name: value} for name, value in others.items())]
    keys = {MatchJob(MatchConfig(**config | change), False).key("a.ply") for change in changes}
    assert len(keys) == len(changes)
    same = {"output": "elsewhere", "workers": 1, "picture": True, "accelerator": "cpu"}
    assert MatchJob(MatchConfig(**config | same), False).key("a.ply") in keys


def test_a_file_that_is_refused_now_loses_its_earlier_match(cli, trained, scans):
    common = ["sources='scans/*'", f"run={trained}", "output=out", "workers=1"]
    assert cli(*common, program=main)[0] == 0
    assert "3 matches in out" in Path("out/index.html").read_text()
    (scans / "1.ply").write_text("no mesh")
    assert cli(*common, program=main)[0] == 1
    page = Path("out/index.html").read_text()
    assert "2 matches in out" in page and "not a readable PLY" in page
    assert not list(Path("out/1").iterdir()) and Path("out/0/match.npz").exists()


def test_results_are_no_sources_and_no_other_mesh_overwrites_them(cli, trained, files):
    common = ["sources='**/*.ply'", f"run={trained}", "workers=1", "output=out"]
    assert cli(*common, program=main)[0] == 0
    code, out, _ = cli(*common, program=main)
    assert code == 0 and "2 of 2 meshes are already matched" in out
    Path("b.ply").rename("c.ply")
    code, out, _ = cli("source=c.ply", f"run={trained}", "output=out/b", program=main)
    assert code == 1 and "out/b contains the match of" in out and "b.ply" in out


def test_a_full_disk_ends_the_command_and_keeps_finished_matches(cli, trained, scans, monkeypatch):
    common = ["sources='scans/*'", f"run={trained}", "output=out", "workers=1"]
    written = []

    @contextlib.contextmanager
    def full_disk(path, sync=False):
        written.append(path)
        if len(written) > 8:  # after Plotly's script and six files: the second mesh's second file
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        with atomic_file(path, sync) as file:
            yield file

    with monkeypatch.context() as patch:
        patch.setattr("meshspiral.data.files.atomic_file", full_disk)
        code, out, err = cli(*common, program=main)
    assert code == 1 and "No space left on device" in out and "Traceback" not in out + err
    assert Path("out/0/view.html").exists() and Path("out/plotly.min.js").exists()
    code, out, _ = cli(*common, program=main)
    assert code == 0 and "1 of 3 meshes are already matched" in out and "2 meshes matched" in out


def test_meshes_of_one_name_get_different_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("x/a.ply", "x/a.obj", "y/a.ply", "y/b.stl"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.touch()
    assert find_sources("**/*", tmp_path / "out") == {
        "x_a.ply": "x/a.ply",
        "x_a.obj": "x/a.obj",
        "y_a": "y/a.ply",
        "y_b": "y/b.stl",
    }
    assert find_sources("x/a.obj", tmp_path / "out") == {"a": "x/a.obj"}
    (tmp_path / "x_a.ply").touch()
    assert sorted(find_sources("**/*a.ply", tmp_path / "y").values()) == ["x/a.ply", "x_a.ply"]


def test_a_killed_command_resumes(cli, trained, files):
    (files / "scans").mkdir()
    for i in range(40):
        mesh = TOYS[f"test/{i % 3}.ply"]
        points = mesh.vertices + i
        trimesh.Trimesh(points, mesh.faces, process=False).export(files / f"scans/{i:02}.ply")
    words = [f"sources='{files}/scans/*'", f"run={trained}", f"output={files}/out", "workers=1"]

    def finished():
        return list(files.glob("out/*/match.npz"))

    process = start([sys.executable, "-m", "src.match", *words], cwd=ROOT)
    wait_for(lambda: len(finished()) >= 5, process)
    process.kill()
    process.wait()
    before = len(finished())
    assert 5 <= before < 40
    code, out, err = cli(*words, program=main)
    assert code == 0, err
    skipped = int(out.split(" of 40 meshes are already matched")[0].split()[-1])
    assert before - 1 <= skipped <= before  # at most the one being written was lost
    for path in finished():
        with np.load(path, allow_pickle=False) as file:
            assert file["template"].shape == (162,)
    assert len(finished()) == 40


def test_a_file_with_brackets_in_its_name_is_no_pattern(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a[1].ply", "a1.ply"):
        (tmp_path / name).touch()
    assert list(find_sources("a[1].ply", Path("out")).values()) == ["a[1].ply"]
    assert list(find_sources("a[12].ply", Path("out")).values()) == ["a1.ply"]
