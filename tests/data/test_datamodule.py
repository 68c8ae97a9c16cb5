"""What a network is served: the right tensors, fresh spirals, and nothing of the numbering."""

import logging
import os
from dataclasses import replace
from itertools import pairwise

import lightning as L
import numpy as np
import pytest
import torch
from tqdm import tqdm

from meshspiral.data import preprocessing
from meshspiral.data.cache import Store
from meshspiral.data.datamodule import CorrespondenceData, EpochSampler, draw_spirals
from meshspiral.data.preprocessing import (
    PatchRecipe,
    Recipe,
    Task,
    by_rows_and_columns,
    descriptor_task,
    first_directions,
    load_task,
    patch_task,
    spiral_task,
)
from meshspiral.data.shapes import DataError, Shape, ShapeSet
from meshspiral.geometry.geodesics import diameter
from meshspiral.geometry.mesh import Mesh, MeshError
from meshspiral.geometry.patches import geodesic_patches
from meshspiral.geometry.shot import shot_descriptors
from meshspiral.geometry.spirals import spiral_table
from meshspiral.geometry.windows import gaussian_windows
from meshspiral.nn.layers import metric_features
from tests.conftest import TOY_SPLIT, toy_shapes
from tests.meshes import bumpy_sphere, lattice, punctured, union

RECIPE = Recipe(shot_radius=0.3, shot_bins=4, seq_len=8)
PATCHES = Recipe(shot_radius=0.3, shot_bins=4, patch=PatchRecipe(0.1, rings=3, rays=8))
GAUSSIAN = replace(PATCHES, patch=replace(PATCHES.patch, weights="gaussian"))


class Toy(ShapeSet):
    def __init__(self, shapes=None):
        self.shapes = shapes or toy_shapes()
        self.template = self.shapes["template.ply"]
        self.names = {split: [n for n in self.shapes if n.startswith(split)] for split in TOY_SPLIT}

    def load(self, name):
        mesh = self.shapes[name]
        return Shape(Mesh(mesh.vertices, mesh.faces, name), np.arange(162), 162)


def serve(store, recipe=RECIPE, seed=0, shapes=None, **options):
    data = CorrespondenceData(Toy(shapes), recipe, store, seed, workers=1, **options)
    data.prepare()
    return data


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path)


class Recorder(L.LightningModule):
    """Notes what it is served."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen = {"train": [], "val": []}

    def note(self, split, batch):
        self.seen[split].append((batch["index"], batch["spirals"].clone(), self.current_epoch))

    def training_step(self, batch, i):
        self.note("train", batch)
        return self.weight * batch["features"].sum()

    def validation_step(self, batch, i):
        self.note("val", batch)

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


def served(data, epochs=2):
    module = Recorder()
    trainer = L.Trainer(max_epochs=epochs, accelerator="cpu", logger=False, barebones=True)
    trainer.fit(module, datamodule=data)
    return module.seen


def test_items_hold_what_they_say(store):
    data = serve(store)
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


def test_meshes_of_one_connectivity_share_one_table(store):
    data = serve(store)
    tables = {item["sequences"].data_ptr() for d in data.datasets.values() for item in d.items}
    assert len(tables) == 1 and len(list((store.root / "spirals").iterdir())) == 1


def test_every_start_is_drawn_equally_often():
    mesh = punctured(bumpy_sphere(), 0.2)
    table = spiral_table(mesh, 4)
    sequences, first = torch.from_numpy(table.sequences), torch.from_numpy(table.first)
    generator = torch.Generator().manual_seed(0)
    draws = torch.stack([draw_spirals(sequences, first, generator)[:, 1] for _ in range(600)])
    assert draws.dtype == torch.int64
    for v in range(len(mesh.vertices)):
        starts = table.sequences[table.first[v] : table.first[v + 1], 1]
        counts = np.array([(draws[:, v] == int(s)).sum() for s in starts])
        assert counts.sum() == 600
        assert np.abs(counts - 600 / len(starts)).max() < 6 * np.sqrt(600 / len(starts))


def test_drawn_spirals_are_rows_of_their_vertex():
    table = spiral_table(union(lattice(3, 3), Mesh([[0, 0, 0]], [])), 5)
    drawn = draw_spirals(torch.from_numpy(table.sequences), torch.from_numpy(table.first))
    for v, row in enumerate(drawn.tolist()):
        assert row in table.sequences[table.first[v] : table.first[v + 1]].tolist()


def test_training_draws_anew_in_every_iteration_and_validation_never(store):
    seen = served(serve(store), epochs=3)
    assert len(seen["train"]) == 18
    first = {index: spirals for index, spirals, epoch in seen["train"] if epoch == 0}
    for index, spirals, epoch in seen["train"]:
        if epoch > 0:
            assert (spirals[:, 1] != first[index][:, 1]).float().mean() > 0.5
    validated = {}
    for index, spirals, _ in seen["val"]:
        assert torch.equal(validated.setdefault(index, spirals), spirals)
    assert not torch.equal(validated[0], validated[1])
    orders = [[i for i, _, e in seen["train"] if e == epoch] for epoch in range(3)]
    assert all(sorted(order) == list(range(6)) for order in orders)
    assert orders[0] != orders[1] or orders[1] != orders[2]


def test_one_seed_one_run_and_another_another(store):
    a, b, c = (served(serve(store, seed=seed))["train"] for seed in (3, 3, 4))
    assert all(x[0] == y[0] and torch.equal(x[1], y[1]) for x, y in zip(a, b, strict=True))
    assert [x[0] for x in a] != [x[0] for x in c]  # the order, and for each mesh the spirals
    spirals = [{index: drawn for index, drawn, epoch in s if epoch == 0} for s in (a, c)]
    assert not any(torch.equal(spirals[0][i], spirals[1][i]) for i in range(6))


def test_a_sampler_that_skips_goes_on_where_it_was():
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
    served = [i for part in parts for i in part]
    assert set(served) == set(range(size)) and len(served) - size < world


# -------------------------------------------------------------------------------------- patches


def dense_samples(patches, rings, rays):
    """[V, rays, rings, V] from rows, and from columns."""
    patches = {name: np.asarray(array) for name, array in patches.items()}
    vertices = len(patches["sample_first"]) - 1
    out = np.zeros((2, len(patches["first"]) - 1, vertices))
    for i, (indices, weights, first) in enumerate(
        [("vertices", "weights", "first"), ("samples", "sample_weights", "sample_first")]
    ):
        matrix = out[i].T if i else out[i]
        for row, (begin, end) in enumerate(pairwise(patches[first])):
            np.add.at(matrix[row], patches[indices][begin:end], patches[weights][begin:end])
    return out.reshape(2, vertices, rays, rings, vertices)


def test_patches_are_served_by_rows_and_by_columns(store):
    data = serve(store, PATCHES)
    item = data.datasets["val"][1]
    assert not item.keys() & {"sequences", "first"}
    dtypes = {name: str(t.dtype).removeprefix("torch.") for name, t in item["patches"].items()}
    assert dtypes == {
        "vertices": "int32",
        "weights": "float32",
        "first": "int32",
        "samples": "int32",
        "sample_weights": "float32",
        "sample_first": "int32",
    }
    mesh = data.shapes.load("val/1.ply").mesh
    table = geodesic_patches(mesh, 0.1 * diameter(mesh), 3, 8, first_directions(mesh))
    expected = np.zeros((162, 3, 8, 162))
    for v, ring, ray, corner in np.ndindex(table.indices.shape):
        at = table.indices[v, ring, ray, corner]
        expected[v, ring, ray, at] += table.weights[v, ring, ray, corner]
    by_rows, by_columns = dense_samples(item["patches"], 3, 8)
    np.testing.assert_allclose(by_rows, expected.transpose(0, 2, 1, 3), atol=1e-6)
    np.testing.assert_array_equal(by_columns, by_rows)


def test_a_sample_that_left_the_surface_has_no_entries():
    mesh = lattice(4, 5)
    arrays = patch_task(mesh, PATCHES).compute(mesh, PATCHES.patch)
    turn = first_directions(mesh)
    whole = geodesic_patches(mesh, 0.1 * diameter(mesh), 3, 8, turn).whole.transpose(0, 2, 1)
    assert 0 < whole.mean() < 1
    np.testing.assert_array_equal(np.diff(arrays["first"]), 3 * whole.ravel())
    patches = by_rows_and_columns(arrays, 20)
    by_rows, by_columns = dense_samples(patches, 3, 8)
    np.testing.assert_array_equal(by_columns, by_rows)
    np.testing.assert_allclose(by_rows.sum(3), whole, atol=1e-6)


def test_gaussian_windows_are_served_in_the_same_order(store):
    data = serve(store, GAUSSIAN)
    mesh = data.shapes.load("val/1.ply").mesh
    table = gaussian_windows(mesh, 0.1 * diameter(mesh), 3, 8, first_directions(mesh))
    expected = np.zeros((162, 3, 8, 162))
    for row, (begin, end) in enumerate(pairwise(table.first)):
        expected.reshape(-1, 162)[row, table.indices[begin:end]] = table.weights[begin:end]
    by_rows, by_columns = dense_samples(data.datasets["val"][1]["patches"], 3, 8)
    np.testing.assert_array_equal(by_rows, expected.transpose(0, 2, 1, 3))
    np.testing.assert_array_equal(by_columns, by_rows)


def test_patches_are_served_as_they_are_in_every_iteration(store):
    data = serve(store, PATCHES)
    item = data.datasets["train"][0]
    assert data.on_after_batch_transfer(item, 0) is item


def test_registered_meshes_have_grids_that_begin_in_directions_of_their_own():
    """What is alike in all of them, such as the first edge of a vertex, would give it away."""
    shapes = toy_shapes()
    a, b, again = (first_directions(shapes[f"train/{i}.ply"]) for i in (0, 1, 0))
    assert np.array_equal(a, again) and np.abs(a - b).min() > 0
    assert np.histogram(np.concatenate([a, b]), 4, (0, 2 * np.pi))[0].min() > 50


def test_patch_radii_follow_the_size_of_the_shape(monkeypatch):
    monkeypatch.setattr(preprocessing, "first_directions", lambda mesh: np.zeros(162))
    mesh = bumpy_sphere()
    large = Mesh(1000 * mesh.vertices, mesh.faces)
    small, large = (patch_task(m, PATCHES).compute(m, PATCHES.patch) for m in (mesh, large))
    np.testing.assert_allclose(small["weights"], large["weights"], atol=1e-5)


# -------------------------------------------------------------------------------- the numbering


def test_renumbered_meshes_give_renumbered_tensors(store):
    """Nothing depends on vertex numbers: descriptors, labels and spirals move along."""
    plain, shuffled = serve(store), serve(store, shuffle_vertices=True)
    for a, b in zip(plain.datasets["train"].items, shuffled.datasets["train"].items, strict=True):
        order = b["labels"]  # vertex i of the shuffled mesh is vertex order[i] of the plain one
        assert not torch.equal(order, a["labels"]) and torch.equal(order.sort()[0], a["labels"])
        torch.testing.assert_close(b["vertices"], a["vertices"][order])
        # sums run in another order, and a vote on the border of a cell may fall to the other side
        rows = (b["features"] - a["features"][order]).abs().amax(1)
        assert (rows < 1e-4).float().mean() > 0.99
        for v in range(0, 162, 5):
            old = int(order[v])
            ours = order[b["sequences"][b["first"][v] : b["first"][v + 1]].long()].tolist()
            theirs = a["sequences"][a["first"][old] : a["first"][old + 1]].tolist()
            assert sorted(ours) == sorted(theirs)


def test_every_mesh_is_shuffled_in_its_own_way_and_the_same_way_again(store):
    once, twice = (serve(store, shuffle_vertices=True).datasets["train"].items for _ in range(2))
    assert all(torch.equal(a["labels"], b["labels"]) for a, b in zip(once, twice, strict=True))
    assert not torch.equal(once[0]["labels"], once[1]["labels"])


# ------------------------------------------------------------------------------------ the cache


def test_a_second_run_computes_nothing(store, monkeypatch):
    serve(store)
    monkeypatch.setattr(preprocessing, "_descriptors", None)
    monkeypatch.setattr(preprocessing, "_spirals", None)
    serve(store)


@pytest.mark.parametrize(
    "change",
    [{"shot_radius": 0.31}, {"shot_bins": 5}, {"seq_len": 9}, {"seq_len": None, "rings": 1}],
)
def test_keys_depend_on_every_parameter(change):
    mesh = bumpy_sphere()
    other = Recipe(**{**RECIPE.__dict__, **change})
    keys = [
        task(mesh, RECIPE).key == task(mesh, other).key for task in (descriptor_task, spiral_task)
    ]
    assert sorted(keys) == [False, True]


@pytest.mark.parametrize(
    "change", [{"radius": 0.11}, {"rings": 4}, {"rays": 16}, {"weights": "gaussian"}]
)
def test_the_key_of_patches_depends_on_every_parameter(change):
    mesh, other = bumpy_sphere(), replace(PATCHES, patch=replace(PATCHES.patch, **change))
    assert patch_task(mesh, other).key != patch_task(mesh, PATCHES).key
    moved = Mesh(mesh.vertices + 1e-9, mesh.faces)
    assert patch_task(moved, PATCHES).key != patch_task(mesh, PATCHES).key


def test_patches_come_back_from_the_cache_as_they_were(store):
    task = patch_task(bumpy_sphere(), PATCHES)
    once, again = load_task(task, store), load_task(task, store)
    assert store.has("patches", task.key) and once.keys() == again.keys()
    assert all(np.array_equal(once[k], again[k]) and once[k].dtype == again[k].dtype for k in once)


def test_keys_depend_on_content_and_code_and_not_on_the_name(monkeypatch):
    mesh = bumpy_sphere()
    moved = Mesh(mesh.vertices + 1e-9, mesh.faces)
    named = Mesh(mesh.vertices, mesh.faces, "another")
    assert descriptor_task(named, RECIPE).key == descriptor_task(mesh, RECIPE).key
    assert descriptor_task(moved, RECIPE).key != descriptor_task(mesh, RECIPE).key
    assert spiral_task(moved, RECIPE).key == spiral_task(mesh, RECIPE).key
    fewer = Mesh(mesh.vertices, mesh.faces[1:])
    assert descriptor_task(fewer, RECIPE).key != descriptor_task(mesh, RECIPE).key
    before = [task(mesh, RECIPE).key for task in (descriptor_task, spiral_task)]
    monkeypatch.setattr(preprocessing, "code_version", lambda *modules: "another")
    after = [task(mesh, RECIPE).key for task in (descriptor_task, spiral_task)]
    assert all(a != b for a, b in zip(before, after, strict=True))


def test_a_damaged_result_is_computed_again(store, caplog):
    before = serve(store).datasets["val"][0]["features"]
    for path in (store.root / "shot").iterdir():
        path.write_bytes(path.read_bytes()[:1000])
    with caplog.at_level(logging.WARNING):
        assert torch.equal(serve(store).datasets["val"][0]["features"], before)
    assert "computing it again" in caplog.text


def test_the_pool_computes_what_one_process_computes(tmp_path, monkeypatch):
    alone = serve(Store(tmp_path / "alone"))
    clock = iter(range(0, 10**6, 100))
    monkeypatch.setattr(preprocessing.time, "perf_counter", lambda: next(clock))  # "this is slow"
    data = CorrespondenceData(Toy(), RECIPE, Store(tmp_path / "pool"), workers=2)
    started = []
    run_in_pool = preprocessing._run_in_pool
    monkeypatch.setattr(
        preprocessing, "_run_in_pool", lambda *a: started.append(len(a[0])) or run_in_pool(*a)
    )
    data.prepare()
    assert started == [11]  # twelve descriptors and one spiral table, less the first two
    for split in TOY_SPLIT:
        for a, b in zip(data.datasets[split].items, alone.datasets[split].items, strict=True):
            assert torch.equal(a["features"], b["features"])


# ------------------------------------------------------------------------------------- bad input


def test_undefined_descriptors_become_zeros_and_are_counted_once(store, caplog):
    shapes = toy_shapes()
    mesh = shapes["train/0.ply"]
    far = mesh.vertices.copy()
    lost = np.flatnonzero((mesh.faces == 0).any(1))
    far[0] += 50  # so far from all others that its neighbourhood is empty
    shapes["train/0.ply"] = Mesh(far, np.delete(mesh.faces, lost, axis=0))
    with caplog.at_level(logging.WARNING):
        data = serve(store, shapes=shapes)
    features = data.datasets["train"].items[0]["features"]
    assert torch.isfinite(features).all() and (features[0] == 0).all()
    assert caplog.text.count("no descriptor at 1 of 162 vertices") == 1
    assert "train/0.ply" in caplog.text


def test_a_mesh_without_area_is_one_message(store):
    shapes = toy_shapes()
    mesh = shapes["val/0.ply"]
    shapes["val/0.ply"] = Mesh(np.zeros_like(mesh.vertices), mesh.faces)
    with pytest.raises(MeshError, match=r"val/0\.ply: no surface area"):
        serve(store, shapes=shapes)


def test_a_split_without_meshes_is_one_message(store):
    shapes = {name: mesh for name, mesh in toy_shapes().items() if not name.startswith("val")}
    with pytest.raises(DataError, match="no mesh to val"):
        serve(store, shapes=shapes)


def test_a_mesh_far_from_the_origin_has_the_same_descriptors(store):
    mesh = bumpy_sphere()
    near = preprocessing._descriptors(mesh, 0.3, 4)["features"]
    far = preprocessing._descriptors(Mesh(mesh.vertices + 1e4, mesh.faces), 0.3, 4)["features"]
    assert (np.abs(far - near).max(axis=1) < 1e-3).mean() > 0.98


def test_a_mesh_far_from_the_origin_has_the_same_metric_information(store):
    near = toy_shapes()
    far = {name: Mesh(mesh.vertices + 4e6, mesh.faces) for name, mesh in near.items()}
    one, two = (serve(store, shapes=shapes).datasets["val"].items[0] for shapes in (near, far))
    spirals = one["sequences"][one["first"][:-1]].long()
    one, two = (metric_features(item["vertices"], spirals, item["unit"]) for item in (one, two))
    torch.testing.assert_close(one, two, rtol=0, atol=1e-5)


def test_a_killed_process_of_the_pool_is_one_message(store):
    tasks = [Task("shot", str(i), os._exit, (1,)) for i in range(2)]
    with pytest.raises(DataError, match=r"data\.workers=1 needs less"):
        preprocessing._run_in_pool(tasks, store, 2, tqdm(disable=True))


def test_labels_outside_the_template_are_refused():
    mesh = lattice(3, 3)
    with pytest.raises(DataError, match=r"1 labels outside 0\.\.8.*vertex 4 has 9"):
        Shape(mesh, [0, 1, 2, 3, 9, 5, 6, 7, 8], 9)
    with pytest.raises(DataError, match=r"9 vertices but labels \(8,\)"):
        Shape(mesh, np.arange(8), 9)
