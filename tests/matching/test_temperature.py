"""Confidences are calibrated by the temperature that validation found."""

from __future__ import annotations

import numpy as np
import torch

from meshspiral import Matcher, scan
from meshspiral.experiment.run_folder import BEST
from meshspiral.training.checkpoints import config_of, read_checkpoint
from tests.conftest import toy_shapes


def test_a_checkpoint_has_the_temperature_of_its_validation(trained):
    saved = read_checkpoint(trained / BEST)
    assert 0.05 < saved["temperature"] < 20 and saved["temperature"] != 1.0


def test_confidences_are_those_of_the_divided_scores(trained):
    mesh = toy_shapes()["test/0.ply"]
    source = scan(mesh.vertices, mesh.faces, "a")
    saved = read_checkpoint(trained / BEST)
    config = config_of(saved)
    found = {}
    for temperature in (1.0, 3.0):
        matcher = Matcher({**saved, "temperature": temperature}, config, unflip=False)
        found[temperature] = matcher.predict(source)
    (plain, one), (cooled, _) = found[1.0], found[3.0]
    np.testing.assert_array_equal(plain.template, cooled.template)
    scores = torch.addmm(one.bias, one.embedding, one.weight.T)
    expected = (scores / 3).softmax(1).amax(1).numpy()
    np.testing.assert_allclose(cooled.confidence, expected, rtol=1e-4)
