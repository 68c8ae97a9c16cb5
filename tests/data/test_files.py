"""Files that appear whole or not at all."""

from __future__ import annotations

import os

import numpy as np
import pytest

from meshspiral.data.files import atomic_file, legal_name, write_arrays, write_file


def test_a_file_takes_its_place_when_it_is_complete(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with atomic_file(path) as file:
        file.write(b"new")
        file.flush()
        assert path.read_text() == "old"
    assert path.read_text() == "new" and os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(type(error)), atomic_file(path) as file:
        file.write(b"new")
        raise error
    if isinstance(error, OSError):
        assert error.filename == str(path)
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.txt"]


def test_text_bytes_and_arrays_are_read_back(tmp_path):
    write_file(tmp_path / "a", "ü\n")
    write_file(tmp_path / "b", b"\x00")
    write_arrays(tmp_path / "c.npz", x=np.arange(3))
    assert (tmp_path / "a").read_text(encoding="utf-8") == "ü\n"
    assert (tmp_path / "b").read_bytes() == b"\x00"
    with np.load(tmp_path / "c.npz") as file:
        assert file["x"].tolist() == [0, 1, 2]


def test_permissions_follow_the_umask(tmp_path):
    before = os.umask(0o027)
    try:
        write_file(tmp_path / "a", "x")
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("name", ["..", ".a", "a/b", "a=b", "ü,*?", "x" * 500, "体" * 200])
def test_names_are_legal_and_different(name):
    legal = legal_name(name)
    assert len(legal.encode()) < 140 and not set(legal) & set("/=,*?\\ ")
    assert legal != legal_name(name + "1") and not legal.startswith(".")
