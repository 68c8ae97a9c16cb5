"""FAUST and its remeshed benchmark, with files of the same layout and size made from bodies."""

import inspect
import random
import shutil
import zipfile
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml

from meshspiral.data.datasets.bodies import Bodies
from meshspiral.data.datasets.faust import Faust
from meshspiral.data.datasets.faust_benchmark import FaustBenchmark
from meshspiral.data.shapes import DataError
from meshspiral.data.sources import open_shapes
from meshspiral.geometry.mesh import Mesh
from tests.helpers import composed

SITES = ["https://faust-leaderboard.is.tuebingen.mpg.de", "http://faust.is.tue.mpg.de"]
REGISTRATIONS = "training/registrations"


def ply(mesh: Mesh) -> bytes:
    """The content of a binary PLY file, the format of FAUST."""
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(mesh.vertices)}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(mesh.faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    return header.encode() + mesh.vertices.astype("<f4").tobytes() + faces.tobytes()


@pytest.fixture(scope="module")
def files() -> dict[str, bytes]:
    bodies = Bodies(6890)
    names = [name for split in ("train", "val", "test") for name in bodies.names[split]]
    return {f"tr_reg_{i:03d}.ply": ply(bodies.load(name).mesh) for i, name in enumerate(names)}


@pytest.fixture(scope="module")
def extracted(files, tmp_path_factory) -> Path:
    """The folder MPI-FAUST, with registrations, and with scans that must not be read."""
    root = tmp_path_factory.mktemp("extracted") / "MPI-FAUST"
    for folder in ["training/registrations", "training/scans", "test/scans"]:
        (root / folder).mkdir(parents=True)
    for name, data in files.items():
        (root / REGISTRATIONS / name).write_bytes(data)
        (root / "training/scans" / name.replace("reg", "scan")).write_bytes(b"no mesh")
    return root


def archive(path: Path, files: dict[str, bytes], folder: str, seed: int = 0) -> Path:
    """A zip archive in shuffled order, with the resource files that macOS adds."""
    members = [(f"{folder}{REGISTRATIONS}/{name}", data) for name, data in files.items()]
    members += [(f"{folder}training/scans/{n.replace('reg', 'scan')}", b"no mesh") for n in files]
    members += [(f"__MACOSX/{folder}{REGISTRATIONS}/._{name}", b"") for name in files]
    random.Random(seed).shuffle(members)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as out:
        for member, data in members:
            out.writestr(member, data)
    return path


@pytest.fixture(scope="module")
def zips(files, tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("zips")
    return {
        "zip": archive(root / "MPI-FAUST.zip", files, "MPI-FAUST/", seed=1),
        "zip without folder": archive(root / "flat.zip", files, "", seed=2),
    }


@pytest.fixture(params=["folder", "parent", "zip", "zip without folder"])
def root(request, extracted, zips) -> Path:
    return {"folder": extracted, "parent": extracted.parent, **zips}[request.param]


def test_every_kind_of_root_gives_the_same_shapes_in_the_same_order(root):
    faust, bodies = Faust(root), Bodies(6890)
    assert faust.names["train"] == [f"tr_reg_{i:03d}" for i in range(70)]
    assert faust.names["val"] == [f"tr_reg_{i:03d}" for i in range(70, 80)]
    assert faust.names["test"] == [f"tr_reg_{i:03d}" for i in range(80, 100)]
    for split, i in [("train", 0), ("train", 13), ("val", 9), ("test", 0), ("test", 19)]:
        shape, body = faust.load(faust.names[split][i]), bodies.load(bodies.names[split][i])
        assert np.allclose(shape.mesh.vertices, body.mesh.vertices, atol=1e-6)
        assert np.array_equal(shape.mesh.faces, body.mesh.faces)
        assert np.array_equal(shape.labels, np.arange(6890)) and shape.template_size == 6890
    first = bodies.load("s0_a_pose").mesh
    assert np.allclose(faust.template.vertices, first.vertices, atol=1e-6)


@pytest.mark.parametrize("member", ["../evil.ply", "/etc/passwd", "a/../../b", "..\\\\evil.ply"])
def test_an_archive_with_paths_outside_of_it_is_rejected(member, files, tmp_path):
    path = archive(tmp_path / "a.zip", files, "MPI-FAUST/", seed=1)
    with zipfile.ZipFile(path, "a") as out:
        out.writestr(member, b"")
    with pytest.raises(DataError, match="which points outside the archive"):
        Faust(path)


def test_an_archive_is_read_without_extracting_it(zips):
    before = sorted(zips["zip"].parent.iterdir())
    Faust(zips["zip"]).load("tr_reg_042")
    assert sorted(zips["zip"].parent.iterdir()) == before


def test_of_two_copies_the_complete_one_is_read(extracted, tmp_path):
    partial = tmp_path / "an interrupted copy" / REGISTRATIONS
    partial.mkdir(parents=True)
    (partial / "tr_reg_001.ply").write_bytes(b"rubbish")
    (tmp_path / "MPI-FAUST").symlink_to(extracted)
    assert len(Faust(tmp_path).load("tr_reg_001").mesh.vertices) == 6890


def test_of_two_complete_copies_the_first_by_name_is_read(tmp_path):
    corners = np.vstack([np.zeros(3), np.eye(3)])
    sides = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    copies = {"a/": ply(Mesh(corners, sides)), "b/": ply(Mesh(2 * corners, sides))}
    for order in ["a/", "b/"], ["b/", "a/"]:
        with zipfile.ZipFile(tmp_path / "two.zip", "w") as out:
            for folder in order:
                for i in range(100):
                    out.writestr(f"{folder}{REGISTRATIONS}/tr_reg_{i:03d}.ply", copies[folder])
        assert Faust(tmp_path / "two.zip").template.vertices.max() == 1


def assert_helps(message: str) -> None:
    """Check for one paragraph: what is missing, where to get it, and what to use instead."""
    assert "\n" not in message
    for part in ["FAUST (", *SITES, "data.root=/path/to/MPI-FAUST", ".zip", "data=bodies_6890"]:
        assert part in message


@pytest.mark.parametrize("unset", [None, ""])
def test_faust_without_a_root_says_where_to_get_it(unset):
    with pytest.raises(DataError, match=r"data\.root is not set") as error:
        Faust(unset)
    assert_helps(str(error.value))


def test_a_missing_root_is_named(tmp_path):
    with pytest.raises(DataError, match=f"{tmp_path}/nothing does not exist") as error:
        Faust(tmp_path / "nothing")
    assert_helps(str(error.value))


@pytest.mark.parametrize("kind", ["text", "cut short", "empty"])
def test_a_file_that_is_not_an_intact_zip_is_rejected(kind, zips, tmp_path):
    path = tmp_path / "MPI-FAUST.zip"
    intact = zips["zip"].read_bytes()
    path.write_bytes(
        {"text": b"a page", "cut short": intact[: len(intact) // 2], "empty": b""}[kind]
    )
    with pytest.raises(DataError, match=f"{path} is neither a folder nor an intact zip") as error:
        Faust(path)
    assert_helps(str(error.value))


def test_a_damaged_member_is_named(zips, tmp_path):
    path = tmp_path / "MPI-FAUST.zip"
    member = f"MPI-FAUST/{REGISTRATIONS}/tr_reg_005.ply"
    data = bytearray(zips["zip"].read_bytes())
    with zipfile.ZipFile(zips["zip"]) as intact:
        start = intact.getinfo(member).header_offset + 2000
    data[start : start + 500] = bytes(500)
    path.write_bytes(data)
    faust = Faust(path)
    assert len(faust.load("tr_reg_004").mesh.vertices) == 6890
    with pytest.raises(DataError, match=f"cannot extract {member}") as error:
        faust.load("tr_reg_005")
    assert_helps(str(error.value))


@pytest.mark.parametrize("kind", ["folder", "zip"])
def test_an_incomplete_set_says_how_many_are_missing_and_the_first(kind, tmp_path):
    present = {f"tr_reg_{i:03d}.ply": b"" for i in range(100) if i not in (7, 31, 99)}
    path = tmp_path / "MPI-FAUST"
    if kind == "zip":
        archive(path, present, "MPI-FAUST/")
    else:
        (path / REGISTRATIONS).mkdir(parents=True)
        for name in present:
            (path / REGISTRATIONS / name).touch()
    with pytest.raises(DataError, match=r"lacks 3 of the 100 .* first .*tr_reg_007\.ply") as error:
        Faust(path)
    assert_helps(str(error.value))


def test_a_folder_or_zip_without_registrations_lacks_all(tmp_path):
    with pytest.raises(DataError, match="lacks 100 of the 100"):
        Faust(tmp_path)
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as other:
        other.writestr("deep/down/training/registrations/tr_reg_000.ply", b"")
    with pytest.raises(DataError, match="lacks 100 of the 100"):
        Faust(tmp_path / "other.zip")


def test_a_registration_with_another_number_of_vertices_is_rejected(extracted, tmp_path):
    (tmp_path / REGISTRATIONS).mkdir(parents=True)
    for file in (extracted / REGISTRATIONS).iterdir():
        (tmp_path / REGISTRATIONS / file.name).symlink_to(file)
    wrong = tmp_path / REGISTRATIONS / "tr_reg_003.ply"
    wrong.unlink()
    wrong.write_bytes(ply(Bodies(1500).template))
    faust = Faust(tmp_path)
    with pytest.raises(DataError, match=r"tr_reg_003\.ply: 1500 vertices.*6890"):
        faust.load("tr_reg_003")


def test_an_unknown_registration_is_rejected(extracted):
    with pytest.raises(DataError, match="'tr_reg_100'"):
        Faust(extracted).load("tr_reg_100")


# ------------------------------------------------------------------------- the benchmark


@cache
def remeshed(number: int) -> tuple[Mesh, np.ndarray]:
    """A substitute for a remeshed shape: another number of vertices, and repeated labels."""
    mesh = Bodies(1500).template
    labels = np.random.default_rng(number).integers(0, 6890, 1500)
    return Mesh(mesh.vertices + number, mesh.faces), labels


def write_benchmark(folder: Path, policy: str, numbers) -> None:
    (folder / policy).mkdir(parents=True, exist_ok=True)
    for number in numbers:
        mesh, labels = remeshed(number)
        stem = folder / policy / f"tr_reg_{policy}_{number:03d}"
        stem.with_suffix(".ply").write_bytes(ply(mesh))
        stem.with_suffix(".txt").write_text("".join(f"{label}\n" for label in labels))


@pytest.fixture(scope="module")
def benchmark_files(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("benchmark")
    write_benchmark(root / "data", "qes", range(80, 100))
    return root


@pytest.fixture
def benchmark_root(benchmark_files, tmp_path) -> Path:
    """A copy of the benchmark's repository that a test may change."""
    return shutil.copytree(benchmark_files, tmp_path / "repository")


@pytest.mark.parametrize("inside", [".", "data"])
def test_benchmark_trains_on_registrations_and_tests_on_remeshed_shapes(
    extracted, benchmark_root, inside
):
    benchmark = FaustBenchmark(extracted, benchmark_root / inside, policy="qes")
    faust = Faust(extracted)
    assert benchmark.names["train"] == faust.names["train"]
    assert benchmark.names["val"] == faust.names["val"]
    assert benchmark.names["test"] == [f"tr_reg_qes_{i:03d}" for i in range(80, 100)]
    assert len(benchmark.template.vertices) == 6890
    assert np.array_equal(benchmark.load("tr_reg_070").labels, np.arange(6890))
    for number in (80, 99):
        mesh, labels = remeshed(number)
        shape = benchmark.load(f"tr_reg_qes_{number:03d}")
        assert np.allclose(shape.mesh.vertices, mesh.vertices, atol=1e-4)
        assert np.array_equal(shape.labels, labels) and shape.template_size == 6890


def test_benchmark_can_train_on_its_own_meshes_of_training_subjects(extracted, benchmark_root):
    data = benchmark_root / "data"
    write_benchmark(data, "iso", [0, 3, 12])
    train = ["iso/tr_reg_iso_01*.ply", "iso/*.ply"]
    benchmark = FaustBenchmark(extracted, data, policy="qes", train=train)
    assert benchmark.names["train"] == ["tr_reg_iso_012", "tr_reg_iso_000", "tr_reg_iso_003"]
    assert np.array_equal(benchmark.load("tr_reg_iso_003").labels, remeshed(3)[1])
    assert len(benchmark.names["test"]) == 20


def test_training_subjects_are_left_out_of_the_test_set(extracted, benchmark_root, caplog):
    write_benchmark(benchmark_root / "data", "iso", [80, 85])
    train = ["iso/tr_reg_iso_08*.ply"]
    benchmark = FaustBenchmark(extracted, benchmark_root, policy="qes", train=train)
    assert benchmark.names["train"] == ["tr_reg_iso_080", "tr_reg_iso_085"]
    assert benchmark.names["test"] == [f"tr_reg_qes_{i:03d}" for i in range(90, 100)]
    assert len(benchmark.names["val"]) == 10
    assert "10 of 20 test shapes show a training subject and are left out" in caplog.text


def test_benchmark_rejects_training_on_all_test_subjects(extracted, benchmark_root):
    with pytest.raises(DataError, match="train contains every subject of test"):
        FaustBenchmark(extracted, benchmark_root, policy="qes", train=["qes/*.ply"])


def test_benchmark_rejects_training_meshes_of_equal_or_invalid_names(extracted, benchmark_root):
    data = benchmark_root / "data"
    write_benchmark(data, "iso", [1])
    (data / "copy").mkdir()
    (data / "copy" / "tr_reg_iso_001.ply").touch()
    with pytest.raises(DataError, match="have the same name"):
        FaustBenchmark(extracted, data, policy="qes", train=["iso/*.ply", "copy/*.ply"])
    (data / "copy" / "mine.ply").touch()
    with pytest.raises(DataError, match=r"name of .*mine\.ply must be tr_reg_<policy>_<number>"):
        FaustBenchmark(extracted, data, policy="qes", train=["copy/mine.ply"])


@pytest.mark.parametrize("policy", ["cloud", None])
def test_an_unknown_policy_is_rejected_and_the_known_ones_are_named(
    extracted, benchmark_root, policy
):
    with pytest.raises(DataError, match=f"iso, qes, mc, dense, got {policy!r}"):
        FaustBenchmark(extracted, benchmark_root, policy=policy)


def test_a_missing_benchmark_gives_an_error_with_its_url(extracted, benchmark_root, tmp_path):
    url = "github.com/nmwsharp/discretization-robust-correspondence-benchmark"
    with pytest.raises(DataError, match=f"benchmark_root is not set.*{url}"):
        FaustBenchmark(extracted, None)
    with pytest.raises(DataError, match=f"{tmp_path}/no contains neither data/iso nor iso.*{url}"):
        FaustBenchmark(extracted, tmp_path / "no")
    for i in (81, 90):
        (benchmark_root / f"data/qes/tr_reg_qes_{i:03d}.txt").unlink()
    with pytest.raises(DataError, match=rf"2 files are missing.*tr_reg_qes_081\.txt.*{url}"):
        FaustBenchmark(extracted, benchmark_root, policy="qes")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: lines[:-1], "1499 labels for a mesh of 1500 vertices"),
        (lambda lines: [*lines, "0"], "1501 labels for a mesh of 1500 vertices"),
        (lambda lines: [], "0 labels for a mesh of 1500 vertices"),
        (lambda lines: [*lines[:6], "nan", *lines[7:]], "line 7 must be .*, got 'nan'"),
        (lambda lines: [*lines[:6], "3.5", *lines[7:]], "line 7 must be .*, got '3.5'"),
        (lambda lines: [*lines[:6], "", *lines[7:]], "line 7 must be .*, got ''"),
        (lambda lines: [*lines[:6], "9" * 30, *lines[7:]], "line 7 must be .*, got '999"),
        (lambda lines: ["6890", *lines[1:]], r"1 labels outside 0\.\.6889.*vertex 0 has 6890"),
        (lambda lines: ["-1", *lines[1:]], r"1 labels outside 0\.\.6889.*vertex 0 has -1"),
    ],
)
def test_an_invalid_label_file_is_rejected_by_name(extracted, benchmark_root, change, message):
    path = benchmark_root / "data/qes/tr_reg_qes_080.txt"
    path.write_text("\n".join(change(path.read_text().splitlines())))
    benchmark = FaustBenchmark(extracted, benchmark_root, policy="qes")
    with pytest.raises(DataError, match=f"tr_reg_qes_080.*{message}"):
        benchmark.load("tr_reg_qes_080")


@pytest.mark.parametrize("data_set", [Faust, FaustBenchmark])
def test_the_configuration_has_every_argument(data_set):
    name = {Faust: "faust", FaustBenchmark: "faust_benchmark"}[data_set]
    config = yaml.safe_load((Path(__file__).parents[2] / f"conf/data/{name}.yaml").read_text())
    assert config["name"] == name
    for argument in inspect.signature(data_set).parameters.values():
        default = None if argument.default is argument.empty else argument.default
        assert config[argument.name] == default


@pytest.mark.parametrize("name", ["faust_remeshed", "bodies_6890_remeshed"])
def test_each_shape_can_be_remeshed_separately(name, extracted, tmp_path):
    root = [f"data.root={extracted}"] if name.startswith("faust") else []
    assert composed([f"data={name}", *root]).data.remesh.model_dump() == {
        "policy": "isotropic",
        "vertices": None,
        "copies": 1,
        "shared": None,
    }
    words = [f"data={name}", *root, "data.remesh.vertices=300", f"data.cache_dir={tmp_path}"]
    shapes = open_shapes(composed([*words, "data.workers=1"]).data)
    name = shapes.names["test"][0]
    shape, source = shapes.load(name), shapes.source(name)
    assert len(shape.mesh.vertices) == 300 and shape.template_size == 6890
    labelled = source.mesh.vertices[shape.labels]  # must be near the vertices
    assert np.linalg.norm(labelled - shape.mesh.vertices, axis=1).max() < 0.05
