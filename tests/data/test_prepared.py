"""Preparing once, and reading from the cache when a mesh is served."""

from __future__ import annotations

import os
import resource
import subprocess
import sys

import numpy as np
import pytest
import torch

from meshspiral.data import dataset
from meshspiral.data.damaged import Damaged
from meshspiral.data.dataset import MeshDataset
from meshspiral.data.datasets.folder import Folder
from meshspiral.data.remeshed import Remeshed
from meshspiral.data.sources import open_data
from meshspiral.geometry.mesh import Mesh
from tests.conftest import TOY_SPLIT, toy_shapes
from tests.data.test_datamodule import recorded
from tests.helpers import ROOT, composed


@pytest.fixture
def config(toy_overrides, tmp_path):
    """Settings of meshes in a folder of the test's own, with a cache of its own."""
    for name, mesh in toy_shapes().items():
        path = tmp_path / "meshes" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(exported(mesh))
    own = [f"data.root={tmp_path / 'meshes'}", f"data.cache_dir={tmp_path / 'cache'}"]
    return lambda *more: composed([*toy_overrides, *own, *more])


def exported(mesh: Mesh) -> bytes:
    import trimesh

    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type="ply")


def opened(config):
    data = open_data(config)
    data.prepare()
    return data


def every_item(data):
    return [item for split in TOY_SPLIT for item in data.datasets[split]]


def assert_same(a, b):
    for one, other in zip(every_item(a), every_item(b), strict=True):
        assert one.keys() == other.keys()
        for key in one.keys() - {"index"}:
            assert torch.equal(one[key], other[key]), key


REMESHED = ("data/remesh=mixed", "data.remesh.vertices=120", "data.remesh.copies=2")


@pytest.mark.parametrize("words", [(), (*REMESHED, "data/damage=scans")], ids=["plain", "remeshed"])
def test_a_second_start_reads_no_mesh(config, monkeypatch, words):
    first = opened(config(*words))
    monkeypatch.setattr(Folder, "load", None)
    monkeypatch.setattr(Remeshed, "load", None)
    monkeypatch.setattr(Damaged, "load", None)
    assert_same(opened(config(*words)), first)


@pytest.mark.parametrize(
    "change", ["seq_len=5", "data.shot.bins=3", "data.half=true", "data.shuffle_vertices=true"]
)
def test_other_settings_are_another_manifest(config, change, monkeypatch):
    opened(config())
    monkeypatch.setattr(Folder, "load", None)
    with pytest.raises(TypeError):
        opened(config(change))


def test_a_changed_file_is_read_again(config, tmp_path):
    before = opened(config())
    mesh = toy_shapes()["train/0.ply"]
    path = tmp_path / "meshes" / "train" / "0.ply"
    path.write_bytes(exported(Mesh(2.5 * mesh.vertices, mesh.faces)))
    after = opened(config())
    ratio = after.datasets["train"][0]["unit"] / before.datasets["train"][0]["unit"]
    assert float(ratio) == pytest.approx(2.5)
    assert torch.equal(after.datasets["train"][1]["unit"], before.datasets["train"][1]["unit"])


def test_a_damaged_manifest_is_written_again(config, tmp_path):
    first = opened(config())
    [manifest] = (tmp_path / "cache" / "manifests").iterdir()
    content = manifest.read_text()
    for damaged in ("", "[]", content[:-9], content.replace('"vertices"', '"corners"')):
        manifest.write_text(damaged)
        assert_same(opened(config()), first)
        assert manifest.read_text() == content


@pytest.mark.parametrize("kind", ["shot", "spiral", "shapes"])
def test_a_result_that_was_removed_meanwhile_is_computed_again(config, tmp_path, kind):
    first, second = opened(config()), opened(config())
    every_item(first)
    for path in (tmp_path / "cache" / kind).iterdir():
        path.unlink()
    assert_same(second, first)


def test_items_are_kept_up_to_a_number_of_bytes(config, monkeypatch):
    train = opened(config()).datasets["train"]
    first = train[0]
    assert train[0]["features"] is first["features"] and train.kept > first["features"].nbytes
    monkeypatch.setattr(dataset, "KEPT", int(1.5 * train.kept))
    second = opened(config()).datasets["train"]
    for _ in range(2):
        items = list(second)
    assert second.kept == train.kept  # one of six
    assert [second[i]["features"] is item["features"] for i, item in enumerate(items)] == [
        True,
        *5 * [False],
    ]


def test_readers_serve_the_same_batches(config):
    """In a process of their own, over several epochs."""
    alone, ahead = (
        recorded(opened(config(f"data.readers={readers}")), epochs=2) for readers in (0, 1)
    )
    for split in ("train", "val"):
        for one, other in zip(alone[split], ahead[split], strict=True):
            assert one[0] == other[0] and one[2] == other[2] and torch.equal(one[1], other[1])


def test_a_reader_serves_more_tensors_than_it_may_open_files(config):
    """A tensor that a reader keeps after it was sent would hold a file open."""
    data = opened(config("data.readers=1"))
    train = data.datasets["train"]
    many = [train._prepared[i % len(train)] for i in range(60)]
    data.datasets["train"] = MeshDataset(data.recipe, many, {})
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (len(os.listdir("/proc/self/fd")) + 60, limits[1]))
    try:  # the reader inherits the limit
        assert sum(1 for _ in data.train_dataloader()) == 60
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_a_script_with_readers_ends(toy_overrides):
    code = f"""if __name__ == "__main__":
    from meshspiral.data.sources import open_data
    from tests.helpers import composed

    data = open_data(composed({[*toy_overrides, "data.readers=1"]!r}))
    data.prepare()
    loader = data.train_dataloader()
    print(len(list(loader)))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0 and done.stdout == f"{TOY_SPLIT['train']}\n", done.stderr


def test_a_damaged_result_beside_a_missing_one_is_computed_again(config, tmp_path):
    data = opened(config())
    train = data.datasets["train"]
    before, prepared = train[0]["features"].clone(), train._prepared[0]
    file = tmp_path / "cache" / "shot" / f"{prepared.described[0]}.safetensors"
    content = bytearray(file.read_bytes())
    content[-1] ^= 64
    file.write_bytes(content)
    (tmp_path / "cache" / "spiral" / f"{prepared.table}.safetensors").unlink()
    again = MeshDataset(data.recipe, train._prepared, {})
    assert torch.equal(again[0]["features"], before)


def test_half_the_space_changes_descriptors_by_a_rounding(config, tmp_path):
    whole = opened(config()).datasets["train"][0]["features"]
    before = sum(p.stat().st_size for p in (tmp_path / "cache" / "shot").iterdir())
    half = opened(config("data.half=true")).datasets["train"][0]["features"]
    after = sum(p.stat().st_size for p in (tmp_path / "cache" / "shot").iterdir())
    assert half.dtype == torch.float32
    np.testing.assert_allclose(half, whole, rtol=2**-11, atol=2**-24)
    assert not torch.equal(half, whole) and (after - before) / before < 0.55
