"""The command `doctor`: what a bug report needs."""

from __future__ import annotations

import torch

from meshspiral.commands import doctor
from tests.helpers import VTK_CRASHES


def test_versions_devices_and_space_are_printed(cli, tmp_path):
    (tmp_path / "cache/shot").mkdir(parents=True)
    (tmp_path / "cache/shot/a.safetensors").write_bytes(bytes(3_000_000))
    code, out, err = cli("cache_dir=cache", program=doctor.main)
    assert code == 0, err
    rows = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert rows["torch"] == torch.__version__
    assert "OpenGL                 renders" in out
    assert "cache                  cache, 3 MB" in out
    for title in ("free memory", "free disk"):
        assert f"{title:<22} " in out and " GB" in out


def test_without_opengl_it_says_what_to_install(cli, monkeypatch):
    monkeypatch.setattr("meshspiral.viz.render.COMMAND", VTK_CRASHES)
    code, out, _ = cli(program=doctor.main)
    assert code == 0 and "OpenGL                 VTK failed" in out and "libegl1" in out
