"""Runs that need a plugin: evaluate and report import it only if their command line names it."""

from __future__ import annotations

import csv
import json
import shutil
import sys
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from meshspiral.commands import evaluate, report
from meshspiral.experiment.run_folder import BEST, CONFIG, METRICS, RunError, read_run_config
from meshspiral.nn.networks import Network
from tests.helpers import QUICK, run

MODULE = """
from pathlib import Path

from meshspiral.nn.networks import FCSNet


class Other(FCSNet, name="other"):
    title = "OTHER-NET"


Path("imported").touch()
"""
PLUGINS = ["plugins=[stranger.module]"]
NEEDED = "model other of a plugin; to import it, add plugins=[stranger.module]"


@pytest.fixture(scope="module")
def trained(tmp_path_factory, toy_overrides):
    folder = tmp_path_factory.mktemp("trained") / "run"
    return folder, run(folder, [*toy_overrides, *QUICK])


@pytest.fixture
def foreign(trained, tmp_path, monkeypatch):
    """Two folders below runs/: "ours", and "foreign" with a network of a plugin.

    The plugin's module lies in tmp_path and creates the file `imported` when it is imported.
    """
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(Network, "registered", {**Network.registered})
    (tmp_path / "stranger").mkdir()
    (tmp_path / "stranger" / "module.py").write_text(MODULE)
    shutil.copytree(trained[0], tmp_path / "runs" / "ours")
    folder = Path(shutil.copytree(trained[0], tmp_path / "runs" / "foreign"))
    rename_model(folder, "other", ["stranger.module"])
    yield folder
    for name in [name for name in sys.modules if name.split(".")[0] == "stranger"]:
        del sys.modules[name]


def rename_model(folder: Path, name: str, plugins: list[str]) -> None:
    """Change the network's name and the plugins in config.yaml and the checkpoint."""
    config = OmegaConf.load(folder / CONFIG)
    config.model.name, config.plugins = name, plugins
    OmegaConf.save(config, folder / CONFIG)
    saved = torch.load(folder / BEST, weights_only=True)
    saved["hyper_parameters"]["config"] = OmegaConf.to_container(config)
    torch.save(saved, folder / BEST)


def test_evaluate_does_not_import_a_plugin_that_only_the_run_names(cli, foreign, tmp_path):
    code, out, err = cli(f"run={foreign}", "shapes=0", program=evaluate.main)
    [line] = (out + err).strip().splitlines()
    assert code == 1 and NEEDED in line
    assert not (tmp_path / "imported").exists() and "stranger.module" not in sys.modules


def test_evaluate_imports_the_plugin_that_its_command_line_names(cli, foreign, trained, tmp_path):
    code, _, err = cli(f"run={foreign}", "shapes=0", *PLUGINS, program=evaluate.main)
    assert code == 0, err
    assert (tmp_path / "imported").exists()
    again = json.loads((foreign / "evaluation/folder" / METRICS).read_text())
    assert again == pytest.approx({key: trained[1][key] for key in again}, rel=1e-6)


def test_evaluate_does_not_import_a_plugin_that_the_run_does_not_need(cli, foreign, tmp_path):
    rename_model(foreign, "fcs", ["stranger.module"])
    code, _, err = cli(f"run={foreign}", "shapes=0", program=evaluate.main)
    assert code == 0, err
    assert not (tmp_path / "imported").exists() and "stranger.module" not in sys.modules


def test_report_omits_a_run_that_needs_a_plugin_and_names_it(cli, foreign, tmp_path):
    code, out, err = cli("runs=runs", "shapes=0", program=report.main)
    assert code == 0, err
    assert "Runs:    1, 1 omitted" in out
    [line] = [line for line in out.splitlines() if line.startswith("omitted: ")]
    assert "runs/foreign" in line and NEEDED in line
    assert NEEDED in (tmp_path / "runs/report/index.html").read_text()
    assert not (tmp_path / "imported").exists() and "stranger.module" not in sys.modules


def test_report_shows_a_run_whose_plugin_the_command_line_names(cli, foreign, tmp_path):
    code, out, err = cli("runs=runs", "shapes=0", *PLUGINS, program=report.main)
    assert code == 0, err
    assert "Runs:    2, 0 omitted" in out
    rows = list(csv.reader((tmp_path / "runs/report/table.csv").read_text().splitlines()))
    assert sorted(row[0] for row in rows[1:]) == ["FCS-NET", "OTHER-NET"]


@pytest.mark.parametrize("program, key", [(evaluate.main, "run"), (report.main, "runs")])
def test_an_unknown_network_without_a_plugin_gives_a_one_line_error(cli, foreign, program, key):
    rename_model(foreign, "other", [])
    code, out, err = cli(f"{key}={foreign}", "shapes=0", program=program)
    [line] = (out + err).strip().splitlines()
    assert (
        code == 1
        and "model.name must be one of acnn, conv, diffusion, fcs, gcnn3, lstm, monet, got other"
        in line
    )


@pytest.mark.parametrize("group", ["model", "neighbourhood", "data"])
def test_the_error_names_the_plugin_and_the_group_that_needs_it(foreign, group):
    config = OmegaConf.load(foreign / CONFIG)
    config.model.name = "fcs"
    config[group].name = "other"
    OmegaConf.save(config, foreign / CONFIG)
    with pytest.raises(RunError) as error:
        read_run_config(foreign)
    assert f"{group} other of a plugin; to import it, add plugins=[stranger.module]" in str(error)
