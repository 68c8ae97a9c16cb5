"""A folder of meshes: which files are used, in which order, and which are rejected."""

import inspect
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

from meshspiral.data.datasets.folder import Folder
from meshspiral.data.shapes import DataError, read_labels

TETRAHEDRON = "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 {}\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n"
PYRAMID = (
    "OFF\n5 6 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n0 0 1\n"
    "3 0 3 2\n3 0 2 1\n3 0 1 4\n3 1 2 4\n3 2 3 4\n3 3 0 4\n"
)
NONE = {"train": [], "val": [], "test": []}


@pytest.fixture
def root(tmp_path) -> Path:
    """template.off (5 vertices), a/0.off .. a/3.off and b/0.off (4 vertices) with labels."""
    root = tmp_path / "meshes"
    (root / "a").mkdir(parents=True)
    (root / "b").mkdir()
    (root / "template.off").write_text(PYRAMID)
    for height, stem in enumerate(["a/2", "a/0", "a/3", "a/1", "b/0"], start=1):
        (root / f"{stem}.off").write_text(TETRAHEDRON.format(height))
        (root / f"{stem}.txt").write_text(f"{height - 1}\n1\n2\n4\n")
    return root


def folder(root, **arguments) -> Folder:
    return Folder(root, "template.off", **{**NONE, **arguments})


def test_meshes_come_with_the_labels_of_their_files(root):
    data = folder(root, train=["a/2.off", "a/0.off"], val=["a/3.off"], test=["b/0.off"])
    assert data.names == {"train": ["a_2", "a_0"], "val": ["a_3"], "test": ["b_0"]}
    assert len(data.template.vertices) == 5
    shape = data.load("a_3")
    assert shape.mesh.vertices[3, 2] == 3
    assert shape.labels.tolist() == [2, 1, 2, 4] and shape.labels.dtype == np.int64
    assert shape.template_size == 5


def test_meshes_that_are_inside_out_are_turned(root):
    """As `match` does, so that a network knows the orientation that it will see."""
    for name in ("template", "a/0"):
        file = root / f"{name}.off"
        mesh = trimesh.load(file, process=False)
        file.write_text(
            trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False).export(
                file_type="off"
            )
        )
    data = folder(root, train=["a/0.off", "a/1.off"])
    for mesh in (data.template, data.load("a_0").mesh, data.load("a_1").mesh):
        assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume > 0


def test_files_are_sorted_within_a_pattern_and_never_repeated(root):
    assert folder(root, train=["a/*.off"]).names["train"] == ["a_0", "a_1", "a_2", "a_3"]
    data = folder(root, train=["b/*", "a/3.off", "a/*.off", "*/[02].off"])
    assert data.names["train"] == ["b_0", "a_3", "a_0", "a_1", "a_2"]
    assert folder(root, train="**/0.off").names["train"] == ["a_0", "b_0"]


def test_a_split_can_be_listed_in_a_text_file(root, tmp_path):
    (root / "train.txt").write_text("a/3.off\n\n  a/[01].off \n")
    assert folder(root, train="train.txt").names["train"] == ["a_3", "a_0", "a_1"]
    elsewhere = tmp_path / "split.txt"
    elsewhere.write_text("b/0.off")
    assert folder(root, test=str(elsewhere)).names["test"] == ["b_0"]
    with pytest.raises(DataError, match=r"val\.txt: cannot read the list"):
        folder(root, val="val.txt")


def test_an_existing_file_name_with_brackets_is_not_a_pattern(root):
    (root / "[ab].off").write_text(PYRAMID)
    (root / "a.off").write_text(PYRAMID)
    assert folder(root, train=["[ab].off"], labels=None).names["train"] == ["[ab]"]


def test_patterns_skip_labels_folders_and_hidden_files(root):
    (root / "a" / "._0.off").write_bytes(b"\0")
    (root / "a" / "folder.off").mkdir()
    assert folder(root, train=["a/*"]).names["train"] == ["a_0", "a_1", "a_2", "a_3"]


@pytest.mark.parametrize("labels", ["identity", None])
def test_identity_gives_vertex_i_the_label_i(root, labels):
    (root / "bent.off").write_text(PYRAMID.replace("0 0 1", "0 1 1"))
    data = folder(root, test=["bent.off", "a/0.off"], labels=labels)
    assert data.load("bent").labels.tolist() == [0, 1, 2, 3, 4]
    with pytest.raises(DataError, match=r"a/0\.off: 4 vertices, but the template .*off has 5"):
        data.load("a_0")


def test_labels_can_be_npy_files_in_another_folder(root):
    (root / "labels").mkdir()
    np.save(root / "labels" / "0_match.npy", np.array([4, 3, 2, 1], dtype=np.uint16))
    data = folder(root, test=["a/0.off"], labels="../labels/{stem}_match.npy")
    assert data.load("a_0").labels.tolist() == [4, 3, 2, 1]


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.array([0.0, 1, 2, 3]), r"must be integers \[V\], got float64"),
        (np.zeros((4, 1), dtype=int), r"must be integers \[V\], got int64 \(4, 1\)"),
        (np.array([0, "x", None, 3], dtype=object), r"not a readable \.npy"),
        (np.arange(3), "3 labels for a mesh of 4 vertices"),
        (np.array([0, 1, 2, 5]), r"outside 0\.\.4.*vertex 3 has 5"),
        (b"", r"not a readable \.npy"),
        (b"PK\x03\x04 cut short", r"not a readable \.npy"),
    ],
)
def test_an_invalid_label_array_is_rejected_by_name(root, array, message):
    if isinstance(array, bytes):
        (root / "a" / "0.npy").write_bytes(array)
    else:
        np.save(root / "a" / "0.npy", array, allow_pickle=True)
    with pytest.raises(DataError, match=rf"a/0\..*{message}"):
        folder(root, test=["a/0.off"], labels="{stem}.npy").load("a_0")


def test_an_npz_archive_named_npy_is_rejected(root):
    with (root / "a" / "0.npy").open("wb") as file:
        np.savez(file, labels=np.arange(4))
    with pytest.raises(DataError, match=r"a/0\.npy: labels must be integers"):
        read_labels(root / "a" / "0.npy")


def test_text_labels_from_windows_are_read(tmp_path):
    path = tmp_path / "labels.txt"
    path.write_bytes("\ufeff3\r\n 1\r\n2 \r\n\r\n".encode())
    assert read_labels(path, 3).tolist() == [3, 1, 2]


def test_a_missing_label_file_is_named_before_anything_is_read(root):
    (root / "a" / "1.txt").unlink()
    with pytest.raises(DataError, match=r"a/1\.txt does not exist; 1\.off needs this label file"):
        folder(root, train=["a/*.off"])
    with pytest.raises(DataError, match=r"a/1\.txt: cannot read the labels"):
        read_labels(root / "a" / "1.txt")


def test_a_mesh_in_two_splits_is_rejected(root):
    with pytest.raises(DataError, match=r"a/2\.off is in train and in test"):
        folder(root, train=["a/*.off"], test=["b/0.off", "a/2.off"])
    (root / "b" / "alias.off").symlink_to(root / "a" / "2.off")
    with pytest.raises(DataError, match=r"b/alias\.off is in train and in val"):
        folder(root, train=["a/2.off"], val=["b/alias.off"], labels="identity")


def test_two_meshes_of_the_same_name_are_rejected(root):
    (root / "a_0.off").write_text(PYRAMID)
    with pytest.raises(DataError, match=r"a/0\.off and .*a_0\.off would both be named a_0"):
        folder(root, train=["a/0.off"], val=["a_0.off"], labels="identity")


@pytest.mark.parametrize("entry", ["c/*.off", "a/9.off", "a/*.txt", "a", ".", "", "**.off"])
def test_an_entry_that_matches_nothing_is_named(root, entry):
    with pytest.raises(DataError) as error:
        folder(root, train=["b/0.off", entry])
    assert repr(entry) in str(error.value)


@pytest.mark.parametrize("where", ["list", "file", "template"])
@pytest.mark.parametrize("entry", ["../outside.off", "a/../../*.off", "a/../b/0.off", "/absolute"])
def test_absolute_paths_and_paths_with_dots_are_rejected(root, entry, where):
    (root.parent / "outside.off").write_text(PYRAMID)
    (root / "train.txt").write_text(entry)
    with pytest.raises(DataError, match=r"must be relative to .* without"):
        if where == "template":
            Folder(root, entry, **NONE)
        else:
            folder(root, train=[entry] if where == "list" else "train.txt", labels="identity")


def test_absolute_paths_into_the_folder_are_rejected_too(root):
    with pytest.raises(DataError, match="must be relative to"):
        folder(root, train=[str(root / "a" / "0.off")])


def test_links_and_labels_outside_the_folder_are_rejected(root):
    outside = root.parent / "outside"
    outside.mkdir()
    (outside / "0.off").write_text(PYRAMID)
    (outside / "0.txt").write_text("0\n1\n2\n3\n")
    (root / "link.off").symlink_to(outside / "0.off")
    (root / "linked").symlink_to(outside)
    (root / "a" / "out.txt").symlink_to(outside / "0.txt")
    for entry in ["link.off", "l*.off", "linked/0.off", "linked/*.off"]:
        with pytest.raises(DataError, match="must be inside"):
            folder(root, train=[entry], labels="identity")
    for labels in ["../../outside/{stem}.txt", str(outside / "{stem}.txt"), "out.txt"]:
        with pytest.raises(DataError, match="must be inside"):
            folder(root, train=["a/0.off"], labels=labels)


def test_names_have_no_marks_of_versions(root):
    for name in ("a@home", "a~2"):
        shutil.copy(root / "a" / "0.off", root / f"{name}.off")
    shapes = folder(root, train=["a@home.off", "a~2.off"], labels="identity")
    assert shapes.names["train"] == ["a_home", "a_2"]
    shutil.copy(root / "a" / "0.off", root / "a@2.off")
    with pytest.raises(DataError, match="would both be named a_2"):
        folder(root, train=["a~2.off", "a@2.off"], labels="identity")


def test_a_list_of_meshes_may_begin_with_a_byte_order_mark(root):
    (root / "list.txt").write_bytes(b"\xef\xbb\xbfa/0.off\n")
    assert folder(root, train="list.txt", labels="identity").names["train"] == ["a_0"]


def test_missing_or_invalid_arguments_are_rejected(root):
    for arguments in [(None, "template.off"), (root, None)]:
        with pytest.raises(DataError, match=r"needs data\.root=.* and data\.template="):
            Folder(*arguments, **NONE)
    with pytest.raises(DataError, match=r"data\.root must be a folder, got .*nothing"):
        folder(root / "nothing", train=["*"])
    with pytest.raises(DataError, match="all empty"):
        Folder(root, "template.off", train=None, val=[], test=None)
    with pytest.raises(DataError, match=r"must match one mesh; 'a/\*\.off' matches 4 meshes"):
        Folder(root, "a/*.off", **NONE)
    with pytest.raises(DataError, match="no mesh is named 'c'"):
        folder(root, train=["a/0.off"]).load("c")


def test_the_configuration_has_every_argument():
    config = yaml.safe_load((Path(__file__).parents[2] / "conf/data/folder.yaml").read_text())
    assert config["name"] == "folder"
    assert inspect.signature(Folder).parameters.keys() <= config.keys()
    assert config["labels"] == inspect.signature(Folder).parameters["labels"].default
    with pytest.raises(DataError, match="needs data"):
        Folder(**{key: config[key] for key in inspect.signature(Folder).parameters})
