"""The command `draw`: neighbourhoods of one vertex, on a shape and its other tessellation."""

from __future__ import annotations

import numpy as np
import pytest
from omegaconf import OmegaConf

from meshspiral.commands.draw import main
from meshspiral.data.shapes import DataError
from meshspiral.data.tensors import sequence_points
from tests.meshes import bumpy_sphere
from tests.neighbourhoods.made import patch, sampled, spiral


def test_both_tessellations_are_drawn(cli, toy_overrides, tmp_path):
    data = [o for o in toy_overrides if o.startswith("data") and "shot" not in o]
    remesh = ["data/remesh=mixed", "data.remesh.vertices=120"]
    output = f"output={tmp_path / 'new folder' / 'around.v2'}"
    code, out, err = cli(*data, *remesh, output, "vertex=3", "seq_len=9", program=main)
    assert code == 0, err
    assert sorted(p.name for p in tmp_path.glob("new folder/*")) == [
        "around.v2.pdf",
        "around.v2.png",
    ]
    assert "around.v2.png" in out


def test_a_set_without_test_shapes_can_be_drawn(cli, toy_overrides, tmp_path):
    data = [o for o in toy_overrides if o.startswith("data") and "shot" not in o]
    output = f"output={tmp_path / 'drawn'}"
    code, _, err = cli(*data, "data.test=[]", output, "vertex=3", "seq_len=9", program=main)
    assert code == 0, err
    assert (tmp_path / "drawn.png").is_file()


def test_both_neighbourhoods_start_where_the_frame_points(cli):
    code, out, _ = cli("--cfg", "job", program=main)
    drawn = OmegaConf.create(out).neighbourhoods
    assert code == 0 and drawn.spiral.start == drawn.sampled.start == "frame"


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["vertex=162"], "vertex must be below 162"),
        (["vertex=-1"], "vertex must be at least 0"),
        (["shape=nobody"], "shape must be a shape of the data set, got nobody"),
        (["neighbourhoods.sampled.rays=0"], "neighbourhoods.sampled.rays must be at least 1"),
        (
            ["neighbourhoods.sampled.name=grid"],
            "sampled.name must be one of anisotropic, disk, operators, patch, sampled, spiral",
        ),
        (["neighbourhoods.sampled.ray=3"], "did you mean"),
    ],
)
def test_wrong_settings_are_one_line(cli, toy_overrides, arguments, message):
    data = [o for o in toy_overrides if o.startswith("data") and "shot" not in o]
    code, out, err = cli(*data, *arguments, program=main)
    assert code in (1, 2) and message in out + err
    assert "Traceback" not in out + err


def test_the_points_are_those_that_the_sequence_visits():
    mesh = bumpy_sphere()
    points = sequence_points(mesh, spiral(7), 5)
    assert points.shape == (7, 3)
    assert all((mesh.vertices == point).all(axis=1).any() for point in points)
    blended = sequence_points(mesh, sampled(blend=True, radius=[0.3, 0.4, 0.5]), 5)
    plain = sequence_points(mesh, sampled(radius=[0.3, 0.4, 0.5]), 5)
    np.testing.assert_allclose(blended[0], mesh.vertices[5], atol=1e-6)
    assert blended.shape == plain.shape and np.abs(blended - plain).max() > 0
    with pytest.raises(DataError, match="patch has no sequences"):
        sequence_points(mesh, patch(), 5)
