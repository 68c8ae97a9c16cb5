"""The data module: its tensors, random spirals, vertex numbering, cache, and bad input."""

import importlib
import logging
import os

import lightning as L
import numpy as np
import pytest
import torch

from meshspiral.data import pool, preprocessing
from meshspiral.data.cache import Cache
from meshspiral.data.datamodule import CorrespondenceData
from meshspiral.data.dataset import EpochSampler
from meshspiral.data.descriptors import Features
from meshspiral.data.descriptors.raw import Raw
from meshspiral.data.descriptors.shot import Shot
from meshspiral.data.descriptors.xyz import Xyz
from meshspiral.data.pool import run_in_pool
from meshspiral.data.preprocessing import (
    descriptor_task,
    neighbourhood_task,
)
from meshspiral.data.settings import ShotSettings
from meshspiral.data.shapes import DataError, Shape, ShapeSet
from meshspiral.geometry.mesh import Mesh, MeshError
from meshspiral.geometry.shot import shot_descriptors
from meshspiral.geometry.spirals import spiral_table
from meshspiral.neighbourhoods.spiral import Spiral
from meshspiral.nn.layers import metric_features
from tests.conftest import TOY_SPLIT, toy_shapes
from tests.meshes import bumpy_sphere, lattice
from tests.neighbourhoods.made import patch, sampled, spiral

SHOT = Shot(ShotSettings(radius=0.3, bins=4, by_area=False))
SHOT_CHANGES = [{}, {"radius": 0.31}, {"bins": 5}, {"by_area": True}]
RAW = {"radius": 0.5, "rings": 2, "rays": 4, "support": 0.8}
FEATURES = Features((SHOT,), unit=0.3)


class Toy(ShapeSet):
    def __init__(self, shapes=None):
        self.shapes = shapes or toy_shapes()
        self.template = self.shapes["template.ply"]
        self.names = {split: [n for n in self.shapes if n.startswith(split)] for split in TOY_SPLIT}

    def load(self, name):
        mesh = self.shapes[name]
        return Shape(Mesh(mesh.vertices, mesh.faces, name), np.arange(162), 162)


def prepared(cache, neighbourhood=None, seed=0, shapes=None, features=FEATURES, **options):
    neighbourhood = neighbourhood or spiral(8)
    data = CorrespondenceData(
        Toy(shapes), features, neighbourhood, cache, seed, workers=1, **options
    )
    data.prepare()
    return data


@pytest.fixture
def cache(tmp_path):
    return Cache(tmp_path)


class Recorder(L.LightningModule):
    """Records an entry of the batches of every split."""

    def __init__(self, recorded="spirals"):
        super().__init__()
        self.recorded = recorded
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.batches = {"train": [], "val": []}

    def record(self, split, batch):
        self.batches[split].append(
            (batch["index"], batch[self.recorded].clone(), self.current_epoch)
        )

    def training_step(self, batch, i):
        self.record("train", batch)
        return self.weight * batch["features"].sum()

    def validation_step(self, batch, i):
        self.record("val", batch)

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


def recorded(data, epochs=2, entry="spirals"):
    module = Recorder(entry)
    trainer = L.Trainer(max_epochs=epochs, accelerator="cpu", logger=False, barebones=True)
    trainer.fit(module, datamodule=data)
    return module.batches


def test_items_hold_descriptors_spirals_and_labels(cache):
    data = prepared(cache)
    assert {s: len(d) for s, d in data.datasets.items()} == TOY_SPLIT
    item = data.datasets["train"][1]
    mesh = data.shapes.load("train/1.ply").mesh
    centred = mesh.vertices - mesh.vertices.mean(0)
    expected = shot_descriptors(centred, mesh.vertex_normals, 0.3 * np.sqrt(mesh.area), 4)
    np.testing.assert_array_equal(item["features"], expected)
    table = spiral_table(mesh, 8)
    np.testing.assert_array_equal(item["sequences"], table.sequences)
    np.testing.assert_array_equal(item["first"], table.first)
    np.testing.assert_array_equal(item["labels"], np.arange(162))
    assert item["unit"] == pytest.approx(0.3 * np.sqrt(mesh.area)) and item["index"] == 1
    dtypes = {
        name: str(t.dtype).removeprefix("torch.") for name, t in item.items() if name != "index"
    }
    assert dtypes == {
        "features": "float32",
        "sequences": "int32",
        "first": "int64",
        "labels": "int64",
        "vertices": "float32",
        "unit": "float32",
    }
    assert data.num_classes == 162 and data.in_features == item["features"].shape[1] == 32 * 5


def test_meshes_of_one_connectivity_share_one_table(cache):
    data = prepared(cache)
    tables = {item["sequences"].data_ptr() for d in data.datasets.values() for item in d}
    assert len(tables) == 1 and len(list((cache.root / "spiral").iterdir())) == 1


def test_training_draws_new_spirals_in_every_epoch_and_validation_never(cache):
    batches = recorded(prepared(cache), epochs=3)
    assert len(batches["train"]) == 18
    first = {index: spirals for index, spirals, epoch in batches["train"] if epoch == 0}
    for index, spirals, epoch in batches["train"]:
        if epoch > 0:
            assert (spirals[:, 1] != first[index][:, 1]).float().mean() > 0.5
    validated = {}
    for index, spirals, _ in batches["val"]:
        assert torch.equal(validated.setdefault(index, spirals), spirals)
    assert not torch.equal(validated[0], validated[1])
    orders = [[i for i, _, e in batches["train"] if e == epoch] for epoch in range(3)]
    assert all(sorted(order) == list(range(6)) for order in orders)
    assert orders[0] != orders[1] or orders[1] != orders[2]


@pytest.mark.parametrize(
    "entry, options",
    [
        ("spirals", {"neighbourhood": spiral(8, start="frame", jitter=1)}),
        ("features", {"features": Features((Xyz(Xyz.Settings(rotate=True)),), 1.0)}),
    ],
)
def test_jitter_and_rotations_are_drawn_in_training_alone(cache, entry, options):
    batches = recorded(prepared(cache, **options), epochs=2, entry=entry)
    one, other = (
        {index: drawn for index, drawn, epoch in batches["train"] if epoch == e} for e in (0, 1)
    )
    assert not any(torch.equal(one[i], other[i]) for i in range(6))
    validated = {}
    for index, drawn, _ in batches["val"]:
        assert torch.equal(validated.setdefault(index, drawn), drawn)


def test_the_seed_determines_the_order_and_the_spirals(cache):
    a, b, c = (recorded(prepared(cache, seed=seed))["train"] for seed in (3, 3, 4))
    assert all(x[0] == y[0] and torch.equal(x[1], y[1]) for x, y in zip(a, b, strict=True))
    assert [x[0] for x in a] != [x[0] for x in c]  # the order, and for each mesh the spirals
    one, other = ({index: drawn for index, drawn, epoch in s if epoch == 0} for s in (a, c))
    assert not any(torch.equal(one[i], other[i]) for i in range(6))


def test_a_sampler_resumes_after_the_skipped_items():
    whole, rest = EpochSampler(10, 5), EpochSampler(10, 5, skip=4)
    for epoch in (2, 3):
        whole.set_epoch(epoch), rest.set_epoch(epoch)
        skipped = 4 if epoch == 2 else 0
        assert list(rest) == list(whole)[skipped:]


@pytest.mark.parametrize("size, world", [(6, 2), (7, 2), (10, 4)])
def test_processes_divide_an_epoch_among_them(size, world):
    samplers = [EpochSampler(size, 5, rank=rank, world=world) for rank in range(world)]
    parts = [list(sampler) for sampler in samplers]
    assert {len(part) for part in parts} == {len(samplers[0])} == {-(-size // world)}
    indices = [i for part in parts for i in part]
    assert set(indices) == set(range(size)) and len(indices) - size < world


# -------------------------------------------------------------------------------- the numbering


def test_renumbered_meshes_give_renumbered_tensors(cache):
    """Descriptors, labels and spirals are renumbered with the vertices."""
    original, shuffled = prepared(cache), prepared(cache, shuffle_vertices=True)
    for a, b in zip(original.datasets["train"], shuffled.datasets["train"], strict=True):
        order = b["labels"]  # shuffled vertex i is original vertex order[i]
        assert not torch.equal(order, a["labels"]) and torch.equal(order.sort()[0], a["labels"])
        torch.testing.assert_close(b["vertices"], a["vertices"][order])
        # sums have another order; rounding may move a point across the border of a SHOT cell
        rows = (b["features"] - a["features"][order]).abs().amax(1)
        assert (rows < 1e-4).float().mean() > 0.99
        for v in range(0, 162, 5):
            old = int(order[v])
            ours = order[b["sequences"][b["first"][v] : b["first"][v + 1]].long()].tolist()
            theirs = a["sequences"][a["first"][old] : a["first"][old + 1]].tolist()
            assert sorted(ours) == sorted(theirs)


def test_every_mesh_has_its_own_reproducible_permutation(cache):
    once, twice = (prepared(cache, shuffle_vertices=True).datasets["train"] for _ in range(2))
    assert all(torch.equal(a["labels"], b["labels"]) for a, b in zip(once, twice, strict=True))
    assert not torch.equal(once[0]["labels"], once[1]["labels"])


# ------------------------------------------------------------------------------------ the cache


def test_a_second_run_computes_nothing(cache, monkeypatch):
    prepared(cache)
    monkeypatch.setattr(Shot, "compute", None)
    monkeypatch.setattr(Spiral, "compute", None)
    prepared(cache)


def test_cache_keys_depend_on_every_parameter():
    mesh = bumpy_sphere()
    settings = [SHOT.settings.model_dump() | change for change in SHOT_CHANGES]
    descriptors = [Shot(ShotSettings(**each)) for each in settings]
    descriptors += [Raw(Raw.Settings(**{**RAW, key: RAW[key] + 1})) for key in RAW]
    assert len({descriptor_task(mesh, each).key for each in descriptors}) == len(
        SHOT_CHANGES
    ) + len(RAW)
    neighbourhoods = [spiral(8), spiral(9), spiral(8, rings=1), spiral(8, rings=2)]
    neighbourhoods += [patch(), patch(radius=0.11), patch(rings=4), patch(rays=16)]
    neighbourhoods += [patch(weights="gaussian"), spiral(8, dilation=2), spiral(8, start="frame")]
    changes = [{}, {"rings": 4}, {"rays": 6}, {"radius": 0.5}, {"radius": [0.5, 0.5, 1.0]}]
    changes += [{"blend": True}, {"relative_to": "diameter"}, {"start": "random"}, {"support": 0.5}]
    changes += [{"by_area": True}]
    neighbourhoods += [sampled(**change) for change in changes]
    assert len({neighbourhood_task(mesh, each).key for each in neighbourhoods}) == 21


def test_cache_keys_depend_on_content_and_code_but_not_on_the_name(monkeypatch):
    mesh = bumpy_sphere()
    moved = Mesh(mesh.vertices + 1e-9, mesh.faces)
    named = Mesh(mesh.vertices, mesh.faces, "another")

    def keys(mesh):
        tasks = [descriptor_task(mesh, SHOT)]
        tasks += [neighbourhood_task(mesh, each) for each in (spiral(8), patch())]
        return [task.key for task in tasks]

    before = keys(mesh)
    assert keys(named) == before
    same = [a == b for a, b in zip(keys(moved), before, strict=True)]
    assert same == [False, True, False]  # spirals depend on the connectivity alone
    assert not set(keys(Mesh(mesh.vertices, mesh.faces[1:]))) & set(before)
    monkeypatch.setattr(preprocessing, "code_version", lambda *modules: "another")
    assert not set(keys(mesh)) & set(before)


def test_cache_keys_depend_on_the_code_of_every_class_of_a_neighbourhood(tmp_path, monkeypatch):
    """Also of a subclass in a user's module."""
    source = """
from meshspiral.neighbourhoods.spiral import Spiral

class Backwards(Spiral):
    pass  # {}
"""
    monkeypatch.syspath_prepend(tmp_path)
    mesh, keys = bumpy_sphere(), []
    for version in "ab":
        (tmp_path / f"backwards_{version}.py").write_text(source.format(version))
        module = importlib.import_module(f"backwards_{version}")
        keys.append(neighbourhood_task(mesh, module.Backwards(spiral(8).settings)).key)
    assert len({*keys, neighbourhood_task(mesh, spiral(8)).key}) == 3


def test_a_damaged_cache_file_is_recomputed(cache, caplog):
    before = prepared(cache).datasets["val"][0]["features"]
    for path in (cache.root / "shot").iterdir():
        content = path.read_bytes()[:1000]
        path.unlink()  # the old file is still mapped
        path.write_bytes(content)
    with caplog.at_level(logging.WARNING):
        assert torch.equal(prepared(cache).datasets["val"][0]["features"], before)
    assert "computing it again" in caplog.text


def test_the_pool_gives_the_results_of_one_process(tmp_path, monkeypatch):
    alone = prepared(Cache(tmp_path / "alone"))
    clock = iter(range(0, 10**6, 100))  # all tasks seem slow
    monkeypatch.setattr(pool.time, "perf_counter", lambda: next(clock))
    data = CorrespondenceData(Toy(), FEATURES, spiral(8), Cache(tmp_path / "pool"), workers=2)
    started = []

    def recorded_pool(function, jobs, *rest):
        jobs = list(jobs)
        started.append(len(jobs))
        return run_in_pool(function, jobs, *rest)

    monkeypatch.setattr(pool, "run_in_pool", recorded_pool)
    data.prepare()
    assert started == [10]  # twelve meshes, less the first two
    for split in TOY_SPLIT:
        for a, b in zip(data.datasets[split], alone.datasets[split], strict=True):
            assert torch.equal(a["features"], b["features"])


# ------------------------------------------------------------------------------------- bad input


def test_undefined_descriptors_become_zeros_and_are_counted_once(cache, caplog):
    shapes = toy_shapes()
    mesh = shapes["train/0.ply"]
    far = mesh.vertices.copy()
    lost = np.flatnonzero((mesh.faces == 0).any(1))
    far[0] += 50  # so far from all others that its neighbourhood is empty
    shapes["train/0.ply"] = Mesh(far, np.delete(mesh.faces, lost, axis=0))
    with caplog.at_level(logging.WARNING):
        data = prepared(cache, shapes=shapes)
    features = data.datasets["train"][0]["features"]
    assert torch.isfinite(features).all() and (features[0] == 0).all()
    assert caplog.text.count("SHOT is undefined at 1 of 162 vertices; using zeros") == 1
    assert "train/0.ply" in caplog.text


def test_a_mesh_without_area_is_rejected(cache):
    shapes = toy_shapes()
    mesh = shapes["val/0.ply"]
    shapes["val/0.ply"] = Mesh(np.zeros_like(mesh.vertices), mesh.faces)
    with pytest.raises(MeshError, match=r"val/0\.ply: surface area must be above 0"):
        prepared(cache, shapes=shapes)


def test_a_split_without_meshes_is_rejected(cache):
    shapes = {name: mesh for name, mesh in toy_shapes().items() if not name.startswith("val")}
    with pytest.raises(DataError, match="the split val must have at least 1 mesh, got 0"):
        prepared(cache, shapes=shapes)


def test_a_mesh_far_from_the_origin_has_the_same_descriptors(cache):
    mesh = bumpy_sphere()
    near = SHOT.compute(mesh)
    far = SHOT.compute(Mesh(mesh.vertices + 1e4, mesh.faces))
    assert (np.abs(far - near).max(axis=1) < 1e-3).mean() > 0.98


def test_a_mesh_far_from_the_origin_has_the_same_metric_information(cache):
    near = toy_shapes()
    far = {name: Mesh(mesh.vertices + 4e6, mesh.faces) for name, mesh in near.items()}
    one, two = (prepared(cache, shapes=shapes).datasets["val"][0] for shapes in (near, far))
    spirals = one["sequences"][one["first"][:-1]].long()
    one, two = (metric_features(item["vertices"], spirals, item["unit"]) for item in (one, two))
    torch.testing.assert_close(one, two, rtol=0, atol=1e-5)


def test_a_killed_process_of_the_pool_raises_a_data_error():
    with pytest.raises(DataError, match=r"killed, .* data\.workers=1 needs less memory"):
        list(run_in_pool(os._exit, [(1,), (1,)], 2, "data.workers=1"))


def test_labels_outside_the_template_are_rejected():
    mesh = lattice(3, 3)
    with pytest.raises(DataError, match=r"1 labels outside 0\.\.8.*vertex 4 has 9"):
        Shape(mesh, [0, 1, 2, 3, 9, 5, 6, 7, 8], 9)
    with pytest.raises(DataError, match=r"9 vertices but labels \(8,\)"):
        Shape(mesh, np.arange(8), 9)
