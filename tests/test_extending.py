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


@pytest.fixture
def clone(tmp_path) -> Path:
    """A clone, in which the files of the page are put where it says."""
    folder = tmp_path / "clone"
    for name in ("conf", "src"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name, content in BLOCKS.items():
        if "." in Path(name).name:
            path = folder / name
            assert not path.exists(), "the page edits no existing file"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content)
    return folder


def call(clone: Path, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", *arguments], cwd=clone, capture_output=True, text=True, timeout=300
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
    out = call(clone, *train, *quick, run)
    assert "conv1d: " in out and "spirals of 20 vertices with metric information" in out
    metrics = json.loads((clone / "outputs/conv1d/metrics.json").read_text())
    assert metrics["parameters"] > 0
    call(clone, *[w.replace("seed=0,1,2", "seed=0") for w in sweep], *quick, "seq_len=8")
    assert "exact match" in call(clone, *evaluate, "shapes=0")
    call(clone, *report, "shapes=0")
    table = (clone / "outputs/report/table.md").read_text()
    assert "CONV1D" in table and "FCS-NET" in table
    out = call(clone, *benchmark, "vertices=1500", "repeats=1", "seq_len=4")
    assert "conv1d" in out
    assert "model.kernel" in call(clone, "src.train", "--help")


def test_a_data_set_can_be_a_plugin(clone, tmp_path):
    train, evaluate, report = words_of("plugin commands")
    small = ["optim.epochs=1", "optim.warmup=0", "model.channels=[12,14,16]", "seq_len=8"]
    call(clone, *train, *small, "picture=false", "hydra.run.dir=outputs/spheres")
    assert "exact match" in call(clone, *evaluate, "shapes=1")
    call(clone, *report)
    assert "spheres" in (clone / "outputs/report/table.md").read_text()

    # without its name on the command line the plugin is not imported, and the message names it
    without = [word for word in evaluate if not word.startswith("plugins")]
    done = subprocess.run(
        [sys.executable, "-m", *without], cwd=clone, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    [line] = [x for x in (done.stdout + done.stderr).splitlines() if x.startswith("error: ")]
    assert "data spheres" in line and "plugins=[my_package.spheres]" in line
