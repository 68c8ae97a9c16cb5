"""Fine-tuning: which weights `init` takes, and what does not fit."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import torch
import trimesh
from omegaconf import OmegaConf

from meshspiral.experiment.run_folder import (
    BEST,
    CONFIG,
    LAST,
    RunError,
    Stopped,
    read_metrics,
    read_run_config,
)
from meshspiral.experiment.runs import claim, resumed_config
from meshspiral.geometry.mesh import Mesh
from meshspiral.matching.matcher import Matcher
from meshspiral.reporting.groups import group_runs
from meshspiral.reporting.runs import read_runs
from meshspiral.training.initial import InitialWeights, checkpoint_of
from meshspiral.training.module import Correspondence
from meshspiral.training.run import train
from tests.conftest import toy_shapes
from tests.helpers import QUICK, composed, run, same_weights, stop_at, weights

FEATURES = 160  # channels of the toy data set's descriptors


@pytest.fixture(scope="module")
def base(tmp_path_factory, toy_overrides):
    """A finished run."""
    folder = tmp_path_factory.mktemp("base")
    run(folder, [*toy_overrides, "optim.epochs=2"])
    return folder


@pytest.fixture(scope="module")
def template():
    return toy_shapes()["template.ply"]


def started(overrides: list[str], template: Mesh, seed: int = 5):
    """The weights that training starts from, by name, those it would have anew, and the log."""
    config = composed(overrides)
    torch.manual_seed(seed)
    module = Correspondence(config.model_dump(), FEATURES, len(template.vertices))
    new = {key: value.clone() for key, value in module.state_dict().items()}
    lines = list(InitialWeights(config, FEATURES).load_into(module, template))
    return module.state_dict(), new, lines


def test_all_weights_are_taken_if_the_template_is_the_same(base, toy_overrides, template):
    for source in (base, base / BEST):
        found, _, lines = started([*toy_overrides, f"init={source}"], template)
        there = weights(base, BEST)
        assert found.keys() == there.keys()
        assert all(torch.equal(found[key], there[key]) for key in there)
        [line] = lines
        assert line.endswith("weights of fcs trained on folder; taken: lift, layers, neck, head")


def changed_templates(template: Mesh) -> dict[str, Mesh]:
    moved = template.vertices * [1.0, 1.0, 1.01]
    sphere = trimesh.creation.icosphere(subdivisions=1)
    return {
        "its template has other vertices": Mesh(moved, template.faces),
        "its template has other faces": template.renumbered(np.arange(162)[::-1]),
        "its template has 162 vertices, ours 42": Mesh(sphere.vertices, sphere.faces),
    }


@pytest.mark.parametrize("number", range(3))
def test_the_head_is_new_if_the_template_differs(base, toy_overrides, template, number):
    """Also if its shape would fit: output i would mean another vertex."""
    reason, other = list(changed_templates(template).items())[number]
    found, new, lines = started([*toy_overrides, f"init={base}"], other)
    there = weights(base, BEST)
    for key, value in found.items():
        expected = new if key.startswith("net.head.") else there
        assert torch.equal(value, expected[key]), key
        assert not key.startswith("net.lift.weight") or not torch.equal(value, new[key])
    assert lines[0].endswith(f"taken: lift, layers, neck; new: head ({reason})")


@pytest.mark.parametrize(
    "overrides, message",
    [
        (["model=lstm"], r"model\.name must be fcs, got lstm"),
        (["model=gcnn3"], r"model\.name must be fcs, got gcnn3"),
        (["seq_len=9"], r"neighbourhood\.seq_len must be 8, got 9"),
        (
            ["model.channels=[12,14,17]", "model.dropout=0.2"],
            r"model\.channels must be \[12, 14, 16\], got \[12, 14, 17\]$",
        ),
        (["metric=true", "optim.lr=0.1"], r"model\.metric must be False, got True$"),
        (["data.shot.bins=5", "data.shot.radius=0.2"], r"data\.shot\.bins must be 4, got 5$"),
        (
            ["data.features=[shot,hks]"],
            r"data\.features must be \['shot'\], got \['shot', 'hks'\]$",
        ),
    ],
)
def test_what_does_not_fit_is_named(base, toy_overrides, tmp_path, overrides, message):
    """Before anything is computed of the meshes, and without a change of torch's generator."""
    torch.manual_seed(3)
    expected = torch.rand(1)
    torch.manual_seed(3)
    with pytest.raises(RunError, match=f"^init={base} does not fit: {message}"):
        run(tmp_path / "run", [*toy_overrides, f"init={base}", *overrides])
    assert torch.equal(torch.rand(1), expected)


def test_settings_that_differ_but_fit_are_logged(base, toy_overrides, template):
    overrides = [*toy_overrides, f"init={base}", "data.shot.radius=0.2", "model.dropout=0.2"]
    _, _, [_, line] = started(overrides, template)
    assert line.endswith(": model.dropout 0.2 (there 0.3), data.shot.radius 0.2 (there 0.3)")


@pytest.mark.parametrize("content", [None, b"no"])
def test_an_init_that_is_no_run_is_a_one_line_error(cli, toy_overrides, tmp_path, content):
    folder = tmp_path / "empty"
    folder.mkdir()
    if content:
        (folder / "checkpoints").mkdir()
        (folder / BEST).write_bytes(content)
    for source, message in {
        "nowhere": "init must be a run folder, a checkpoint or bundled, got nowhere",
        str(folder): "is damaged" if content else f"has no {BEST}: it is no run",
    }.items():
        code, out, err = cli(*toy_overrides, f"init={source}")
        assert code == 1 and message in out + err
        assert (out + err).count("error: ") == 1 and "Traceback" not in out + err
    claim(folder, composed(toy_overrides))
    if not content:
        with pytest.raises(RunError, match="no epoch has finished"):
            checkpoint_of(str(folder))


def test_bundled_is_the_network_of_the_matcher(toy_overrides, template):
    size = ["model.channels=[150,225,300]", "data.shot.bins=16"]
    config = composed([*toy_overrides, *size, "variant=matcher", "init=bundled"])
    module = Correspondence(config.model_dump(), 544, 162)
    [first, *_] = InitialWeights(config, 544).load_into(module, template)
    assert "weights of fcs trained on anny" in first
    theirs = Matcher.load()._predictor.module.net
    for ours, there in zip(module.net.layers.parameters(), theirs.layers.parameters(), strict=True):
        assert torch.equal(ours, there)


# --------------------------------------------------------------------------------- whole runs


def test_a_run_starts_from_the_weights(base, toy_overrides, tmp_path, caplog):
    """With a learning rate of nearly 0 it stays there; without init it does not get there."""
    caplog.set_level(logging.INFO)
    still = [*toy_overrides, "optim.epochs=1", "optim.lr=1e-12"]
    tuned = run(tmp_path / "tuned", [*still, f"init={base}"])
    assert "taken: lift, layers, neck, head" in caplog.text
    before, after = weights(base, BEST), weights(tmp_path / "tuned")
    assert all(torch.allclose(before[key], after[key], atol=1e-9) for key in before)
    expected = read_metrics(base)["test/loss"]
    assert tuned["test/loss"] == pytest.approx(expected, abs=1e-4)
    assert run(tmp_path / "new", still)["test/loss"] != pytest.approx(expected, abs=1e-2)


def test_a_stopped_fine_tuned_run_resumes_to_the_same_weights(
    base, toy_overrides, tmp_path, monkeypatch
):
    """Also once the weights that it started from are gone."""
    source = tmp_path / "source.ckpt"
    source.write_bytes((base / BEST).read_bytes())
    overrides = [*toy_overrides, f"init={source}", "optim.epochs=2"]
    run(tmp_path / "whole", overrides)
    assert not same_weights(tmp_path / "whole", base)
    go_on = stop_at(monkeypatch, 3)
    with pytest.raises(Stopped):
        run(tmp_path / "stopped", overrides)
    go_on()
    source.unlink()
    resume = [f"resume={tmp_path / 'stopped'}"]
    train(resumed_config(composed(resume), resume), tmp_path / "stopped")
    assert same_weights(tmp_path / "whole", tmp_path / "stopped")


def test_resume_wins_over_init_once_the_run_has_checkpoints(base, toy_overrides, tmp_path, caplog):
    """Before its first checkpoint, the run starts from init, and its config says so."""
    folder = tmp_path / "run"
    folder.mkdir()
    claim(folder, composed(toy_overrides))
    words = [f"resume={folder}", f"init={base}"]
    config = resumed_config(composed(words), words)
    assert config.init == str(base) and not caplog.text
    train(config, folder)
    assert read_run_config(folder).init == str(base)
    assert OmegaConf.load(folder / CONFIG).model.channels == [12, 14, 16]
    assert resumed_config(composed(words), words).init == str(base) and not caplog.text
    assert (folder / LAST).is_file()
    words[1] = "init=bundled"
    assert resumed_config(composed(words), words).init == str(base)
    assert "init=bundled is ignored" in caplog.text


def test_a_config_without_init_is_read(tmp_path, toy_overrides):
    claim(tmp_path, composed(toy_overrides))
    old = OmegaConf.load(tmp_path / CONFIG)
    del old.init
    OmegaConf.save(old, tmp_path / CONFIG)
    assert read_run_config(tmp_path).init is None


def test_a_sweep_over_seeds_starts_each_from_the_weights(base, cli, toy_overrides, tmp_path):
    sweep = [*toy_overrides, *QUICK, f"init={base},null", "seed=0,1"]
    code, out, err = cli("-m", *sweep, "hydra.sweep.dir=sweep")
    assert code == 0, err
    folders = sorted(path for path in (tmp_path / "sweep").iterdir() if path.is_dir())
    assert len(folders) == 4 and len({folder.name for folder in folders}) == 4
    assert {read_run_config(folder).init for folder in folders} == {str(base), None}
    assert out.count("taken: lift, layers, neck, head") == 2
    runs, _ = read_runs(str(tmp_path / "sweep"))
    groups = group_runs(runs)
    assert [len(group.runs) for group in groups] == [2, 2]
    assert {dict(group.others)["init"] for group in groups} == {str(base), None}
