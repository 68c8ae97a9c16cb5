"""The package as it is installed: a small wheel, a console script, everything it needs inside."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from meshspiral.data.datasets.bodies import Bodies
from tests.helpers import ROOT


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel, built from a copy of what git would give a user."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    for name in listed:
        if (ROOT / name).is_file() and not name.startswith(("tests/", "docs/", "notebooks/")):
            target = source / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes((ROOT / name).read_bytes())
    build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(out), str(source)]
    subprocess.run(build, check=True, capture_output=True)
    [path] = out.glob("meshspiral-*.whl")
    return path


@pytest.fixture(scope="module")
def python(wheel, tmp_path_factory) -> Path:
    """The interpreter of a fresh virtual environment with the wheel; what it depends on is that of
    this environment."""
    folder = tmp_path_factory.mktemp("venv")
    venv.create(folder, with_pip=False, symlinks=True)
    [packages] = folder.glob("lib/python*/site-packages")
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", f"--target={packages}"]
    subprocess.run([*install, str(wheel)], check=True, capture_output=True)
    # behind it, without their .pth files: an editable install of the clone is not among them
    ours = next(path for path in sys.path if path.endswith("site-packages"))
    (packages / "dependencies.pth").write_text(f"{ours}\n")
    for compiled in (ROOT / "src").rglob("*.nb?"):  # numba's code, which takes long to compile
        copy = packages / compiled.relative_to(ROOT / "src")
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(compiled, copy)
    (folder / "bin" / "meshspiral").write_text(
        f"#!{folder}/bin/python\nfrom meshspiral.__main__ import main\nmain()\n"
    )
    (folder / "bin" / "meshspiral").chmod(0o755)
    return folder / "bin" / "python"


def call(command: list, folder: Path) -> subprocess.CompletedProcess:
    """Run a command in a folder that is not the clone."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300
    )


def test_the_wheel_is_small_and_complete(wheel):
    assert wheel.stat().st_size < 15e6
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    for name in ("conf/train.yaml", "conf/model/fcs.yaml", "conf/cli/base.yaml"):
        assert f"meshspiral/{name}" in names
    tracked = {
        f"meshspiral/{path.relative_to(ROOT / 'src' / 'meshspiral')}"
        for path in (ROOT / "src" / "meshspiral").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert tracked <= set(names)
    assert not [name for name in names if name.startswith(("src/", "tests/"))]


def test_an_installed_package_matches(python, tmp_path):
    script = (
        "import meshspiral, sys; from meshspiral import Matcher; m = Matcher.load(); "
        "print(len(m.template.vertices)); print(meshspiral.__file__)"
    )
    done = call([python, "-c", script], tmp_path)
    assert done.returncode == 0, done.stderr
    vertices, where = done.stdout.split()
    assert vertices == "1500" and str(python.parents[1]) in where

    bodies = Bodies(1500)
    for name, file in (("s8_t_pose", "a.ply"), ("s9_squat", "b.ply")):
        mesh = bodies.load(name).mesh
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / file)
    script = python.parent / "meshspiral"
    done = call([script, "match", "source=a.ply", "target=b.ply", "picture=false"], tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    matched = np.loadtxt(tmp_path / "outputs/matches/a_to_b/map.txt", dtype=int)
    assert (matched == np.arange(1500)).mean() > 0.4  # the bodies are registered


def test_the_console_script_names_its_commands(python, tmp_path):
    script = python.parent / "meshspiral"
    done = call([script], tmp_path)
    assert done.returncode == 0
    for command in ("train", "evaluate", "match", "report", "meshes", "benchmark"):
        assert f"  {command} " in done.stdout
    done = call([script, "trian"], tmp_path)
    assert done.returncode == 2
    assert done.stderr == "error: unknown command trian; did you mean train?\n"


def test_an_installed_package_trains(python, toy_overrides, tmp_path):
    script = python.parent / "meshspiral"
    done = call([script, "train", *toy_overrides, "optim.epochs=1"], tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    [metrics] = tmp_path.glob("outputs/*/*_fcs/metrics.json")
    done = call([script, "train", f"resume={metrics.parent}", "seed=3"], tmp_path)
    assert done.returncode == 1
    assert "error: seed=3 contradicts the run" in done.stdout + done.stderr
