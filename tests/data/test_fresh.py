"""Epochs on fresh versions of the training shapes."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.data.damaged import Damaged
from meshspiral.data.dataset import EpochSampler
from meshspiral.data.datasets.bodies import Bodies
from meshspiral.data.settings import DamageSettings
from meshspiral.data.shapes import DataError, epoch_of, name_in
from meshspiral.data.sources import open_data, open_shapes
from tests.data.test_datamodule import Toy
from tests.helpers import composed, run, same_weights

NOISE = {
    "noise": 0.01,
    "warp": 0.0,
    "bumps": 0.0,
    "share": 0.0,
    "cut": 0.0,
    "holes": 0,
    "hole_radius": 0.1,
}
DAMAGE = DamageSettings(**NOISE, extremities=0.0, component=0.0, missing=0.0, size=0.0, seed=0)
FRESH = ["data/damage=scans", "data.damage.share=0", "data.fresh=true"]


def test_names_of_epochs():
    assert name_in(0, "train_0001_02") == "train_0001_02"
    assert epoch_of(name_in(3, "train_0001_02~2")) == ("train_0001_02~2", 3)
    assert epoch_of("train_0001_02") == ("train_0001_02", 0)


def test_each_epoch_has_other_damage_which_its_name_decides():
    shapes = Damaged(Toy(), DAMAGE)
    name = shapes.names["train"][0]
    meshes = [shapes.load(name_in(epoch, name)).mesh.vertices for epoch in (0, 1, 2, 1)]
    assert not np.allclose(meshes[0], meshes[1]) and not np.allclose(meshes[1], meshes[2])
    np.testing.assert_array_equal(meshes[1], meshes[3])


def test_the_sampler_asks_for_the_version_of_its_epoch():
    sampler = EpochSampler(5, seed=0, fresh=True)
    for epoch in range(3):
        sampler.set_epoch(epoch)
        assert sorted(sampler) == [5 * epoch + i for i in range(5)]
    plain = EpochSampler(5, seed=0)
    plain.set_epoch(2)
    assert sorted(plain) == list(range(5))


def test_items_behind_the_last_are_the_shapes_of_later_epochs(toy_overrides):
    data = open_data(composed([*toy_overrides, *FRESH]))
    data.prepare(["train"])
    train = data.datasets["train"]
    assert len(train) == len(list(train)) == 6
    first, later, again = train[2], train[2 + 6], train[2 + 6]
    assert first["index"] == later["index"] == 2
    assert not np.allclose(first["vertices"], later["vertices"])
    np.testing.assert_array_equal(later["features"], again["features"])
    assert (first["labels"] == later["labels"]).all()


def test_without_other_versions_an_item_behind_the_last_is_an_error(toy_overrides):
    data = open_data(composed(toy_overrides))
    data.prepare(["train"])
    with pytest.raises(IndexError, match=r"7 must be an item, 0\.\.5"):
        data.datasets["train"][7]
    with pytest.raises(DataError, match="needs shapes that can be made anew"):
        open_data(composed([*toy_overrides, "data.fresh=true"]))


def test_fresh_runs_agree_and_differ_from_others(toy_overrides, tmp_path):
    words = [*toy_overrides, *FRESH, "optim.epochs=2"]
    for name in ("one", "two"):
        run(tmp_path / name, [*words, f"data.readers={int(name == 'two')}"])
    assert same_weights(tmp_path / "one", tmp_path / "two")
    run(tmp_path / "same", [*words, "data.fresh=false"])
    assert not same_weights(tmp_path / "one", tmp_path / "same")


@pytest.mark.parametrize("name", ["anna@home", "anna~2"])
def test_names_that_look_like_epochs_or_copies_are_refused(monkeypatch, name):
    monkeypatch.setattr(
        Bodies, "__init__", lambda self, vertices: setattr(self, "names", {"test": [name]})
    )
    with pytest.raises(DataError, match=f"must be without '@' and '~', got '{name}'"):
        open_shapes(composed([]).data)
