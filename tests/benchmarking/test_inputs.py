"""The torus that sizes without a body are measured on."""

import numpy as np
import pytest
import torch

from meshspiral.benchmarking.inputs import body_batch, torus, torus_batch
from meshspiral.data.sources import open_data
from meshspiral.data.tensors import draw
from meshspiral.neighbourhoods import Neighbourhood
from tests.helpers import composed


@pytest.mark.parametrize("vertices", [7, 8, 31, 97, 1500, 6899])
def test_a_torus_of_any_size_is_closed_and_regular(vertices):
    faces = torus(vertices).faces
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 2).all()
    assert (np.bincount(edges.ravel(), minlength=vertices) == 6).all()
    assert vertices - len(edges) + len(faces) == 0  # Euler's characteristic


def test_a_torus_has_the_area_and_volume_of_the_surface():
    """Faces wind counter-clockwise as seen from outside, or the volume would be negative."""
    mesh = torus(6899)
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert volume == pytest.approx(2 * np.pi**2 * 2, rel=0.01)
    assert mesh.area == pytest.approx(4 * np.pi**2 * 2, rel=0.01)


@pytest.mark.parametrize("model", ["fcs", "gcnn3"])
def test_a_torus_batch_has_the_entries_of_a_training_batch(model, toy_overrides):
    config = composed([f"model={model}", *toy_overrides])
    data = open_data(config)
    data.prepare(["train"])
    item = data.datasets["train"][0]
    batch = torus_batch(config, 97, 20)
    assert batch.keys() == item.keys()
    for batch_, size in ((batch, 97), (item, 162)):
        drawn = draw(Neighbourhood.of(config.neighbourhood), batch_, 0)
        assert drawn["features"].shape == (size, 160)
        assert drawn["vertices"].shape == (size, 3)
        assert len(drawn["labels"]) == size
    assert 10 < batch["labels"].max() < 20
    norms = batch["features"].norm(dim=1)
    torch.testing.assert_close(norms.mean(), torch.tensor(1.0), rtol=0.1, atol=0)


def test_a_body_batch_is_the_item_of_training(tmp_path, monkeypatch):
    from meshspiral.benchmarking import inputs

    config = composed(["model=fcs", "seq_len=6", f"data.cache_dir={tmp_path}", "data.workers=1"])
    data = open_data(config)
    data.shapes.names = {split: names[:1] for split, names in data.shapes.names.items()}
    monkeypatch.setattr(inputs, "open_shapes", lambda _: data.shapes)
    data.prepare(["train"])
    item, batch = data.datasets["train"][0], body_batch(config, "cpu")
    assert batch.keys() == item.keys()
    for key, value in item.items():
        torch.testing.assert_close(batch[key], value)
