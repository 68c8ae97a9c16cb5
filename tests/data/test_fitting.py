"""Settings of descriptors that are fitted to the training shapes, and to no others."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from meshspiral.data.descriptors import Features
from meshspiral.data.sources import open_data, open_shapes
from meshspiral.evaluation.retest import config_on_data
from meshspiral.experiment.run_folder import BEST, read_run_config
from meshspiral.experiment.runs import claim
from meshspiral.geometry.laplacian import spectrum
from meshspiral.training.checkpoints import config_of
from tests.helpers import composed, run

GEOVEC = ["data.features=geovec", "data.geovec.channels=12", "data.geovec.eigenfunctions=20"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory, toy_overrides):
    """The folder of a run on geometry vectors, and its command line."""
    folder = tmp_path_factory.mktemp("geovec")
    words = [*toy_overrides, *GEOVEC, "optim.epochs=1"]
    run(folder, words)
    return folder, words


def expected(words: list[str]) -> float:
    shapes = open_shapes(composed(words).data)
    meshes = [shapes.load(name).mesh for name in shapes.names["train"]]
    return float(np.percentile([spectrum(m, 20).values * m.area for m in meshes], 99))


def test_bands_end_at_the_99th_percentile_of_the_training_shapes(toy_overrides):
    words = [*toy_overrides, *GEOVEC]
    [descriptor] = open_data(composed(words)).features.descriptors
    assert descriptor.settings.largest == pytest.approx(expected(words), rel=1e-9)
    others = [*words, "data.train=[val/*.ply]", "data.val=[train/*.ply]"]
    [other] = open_data(composed(others)).features.descriptors
    assert other.settings.largest != descriptor.settings.largest


def test_a_value_that_is_given_stays(toy_overrides):
    data = open_data(composed([*toy_overrides, *GEOVEC, "data.geovec.largest=77.5"]))
    assert data.features.descriptors[0].settings.largest == 77.5


def test_checkpoint_and_run_folder_carry_it(trained):
    folder, words = trained
    value = expected(words)
    saved = torch.load(folder / BEST, weights_only=True)
    assert config_of(saved).data.geovec.largest == pytest.approx(value)
    assert read_run_config(folder).data.geovec.largest == pytest.approx(value)


def test_another_data_set_is_described_as_the_training_shapes_were(trained):
    folder, words = trained
    config = config_on_data(
        read_run_config(folder), {"train": ["val/*.ply"], "val": ["train/*.ply"]}
    )
    [descriptor] = open_data(config).features.descriptors
    assert descriptor.settings.largest == pytest.approx(expected(words))


def test_the_same_command_resumes_the_run(trained):
    folder, words = trained
    claim(folder, composed(words))  # no difference
    metrics = run(folder, words)
    assert np.isfinite(metrics["test/exact_match"])


def test_other_descriptors_are_not_fitted():
    features = Features.of(composed([]).data)
    assert not any(descriptor.unfitted for descriptor in features.descriptors)
    assert features.settings_in(composed([]).data) == composed([]).data
