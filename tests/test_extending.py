"""The page docs/extending.md, run as a reader would: its files, then its commands."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers import ROOT

PAGE = (ROOT / "docs" / "extending.md").read_text()
BLOCKS = dict(re.findall(r'```\w+ title="([^"]+)"\n(.*?)```', PAGE, flags=re.S))


@pytest.fixture(scope="module")
def clone(tmp_path_factory) -> Path:
    """A clone, in which the files of the page are put where it says."""
    folder = tmp_path_factory.mktemp("extended")
    for name in ("conf", "src"):
        shutil.copytree(ROOT / name, folder / name)  # with what numba has compiled
    for name, content in BLOCKS.items():
        if "." in Path(name).name:
            path = folder / name
            assert not path.exists(), "the page edits no existing file"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content)
    return folder


DRIVER = """
import importlib, logging, sys
sys.path.insert(0, ".")
for words in eval(sys.argv[1]):
    logging.getLogger().handlers.clear()
    module, sys.argv = words[0], words
    try:
        importlib.import_module(module).main()
    except SystemExit as stop:
        if stop.code:
            raise
"""


def call(clone: Path, *commands: list[str]) -> str:
    """Run commands in the clone, one after another in one process, to import torch once."""
    done = subprocess.run(
        [sys.executable, "-c", DRIVER, repr(commands)],
        cwd=clone,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def words_of(title: str) -> list[list[str]]:
    """The commands of a block, each as the words after `python -m`."""
    import shlex

    lines = BLOCKS[title].strip().splitlines()
    assert all(line.startswith("python -m src.") for line in lines)
    return [shlex.split(line)[2:] for line in lines]


def test_a_network_is_a_module_and_a_yaml_file(clone, toy_overrides):
    toy = [o for o in toy_overrides if not o.startswith(("seq_len", "optim"))]
    quick = [*toy, "optim.epochs=1", "optim.warmup=0"]
    train, sweep, evaluate, report, benchmark = words_of("commands")
    run = "hydra.run.dir=outputs/conv1d"
    out = call(
        clone,
        [*train, *quick, run],
        [*(w.replace("seed=0,1,2", "seed=0") for w in sweep), *quick, "seq_len=8"],
        [*evaluate, "shapes=0"],
        [*report, "shapes=0"],
        [*benchmark, "vertices=1500", "repeats=1", "seq_len=4"],
        ["src.train", "--help"],
    )
    for line in (
        "conv1d: ",
        "spirals of 20 vertices with metric information",
        "Test on 3 unseen meshes",
        "reference ms",
        "model.kernel             length of the convolution's kernel, odd (conv1d)",
    ):
        assert line in out
    metrics = json.loads((clone / "outputs/conv1d/metrics.json").read_text())
    tested = json.loads((clone / "outputs/conv1d/evaluation/folder/metrics.json").read_text())
    assert tested["test/exact_match"] == pytest.approx(metrics["test/exact_match"])
    table = (clone / "outputs/report/table.md").read_text()
    assert "CONV1D" in table and "FCS-NET" in table
    [benchmarked] = clone.glob("outputs/benchmark/*/benchmark.json")
    assert [row["network"] for row in json.loads(benchmarked.read_text())["steps"]] == ["conv1d"]


def test_a_neighbourhood_is_a_module_and_a_yaml_file(clone, toy_overrides):
    toy = [o for o in toy_overrides if not o.startswith(("seq_len", "optim"))]
    quick = [*toy, "optim.epochs=1", "optim.warmup=0", "hydra.run.dir=outputs/nearest"]
    [train] = words_of("neighbourhood commands")
    out = call(clone, [*train, *quick], ["src.report", "runs=outputs/nearest", "shapes=0"])
    assert "the 10 nearest vertices without metric information" in out
    assert (clone / "outputs/nearest/metrics.json").is_file()


def test_a_descriptor_is_a_module(clone, toy_overrides):
    quick = [*toy_overrides, "optim.epochs=1", "optim.warmup=0", "hydra.run.dir=outputs/defect"]
    [train] = words_of("descriptor commands")
    out = call(clone, [*train, *quick], ["src.train", "--help"])
    assert "data.defect.steps        smoothing steps; each adds a channel" in out
    config = (clone / "outputs/defect/config.yaml").read_text()
    assert "defect:\n    steps: 3" in config


def test_a_data_set_can_be_a_plugin(clone):
    """What happens without `plugins=` is tested in commands/test_plugins.py."""
    train, evaluate, report = words_of("plugin commands")
    small = ["optim.epochs=1", "optim.warmup=0", "model.channels=[12,14,16]", "seq_len=8"]
    run = [*train, *small, "picture=false", "hydra.run.dir=outputs/spheres"]
    out = call(clone, run, [*evaluate, "shapes=0"], [*report, "shapes=1"])
    assert out.count("exact match") == 2
    assert "spheres" in (clone / "outputs/report/table.md").read_text()
