"""The command `cache`."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest

from meshspiral.commands.cache import main
from meshspiral.data.cache import Cache


@pytest.fixture
def cache(tmp_path):
    cache = Cache(tmp_path / "cache")
    for days, kind in enumerate(("shot", "spiral", "shapes")):
        cache.save(kind, "a", {"x": np.zeros(1000)})
        then = time.time() - 10.0 * days * 86400
        os.utime(cache.path(kind, "a"), (then, then))
    return cache


def test_it_shows_every_kind_and_removes_nothing(cli, cache):
    code, out, _ = cli(f"cache_dir={cache.root}", program=main)
    rows = [" ".join(line.split()) for line in out.splitlines()]
    assert code == 0 and rows[0] == "kind files MB last read"
    assert rows[1:] == [
        "shapes 1 0.0 20.0 days",
        "shot 1 0.0 0.0 days",
        "spiral 1 0.0 10.0 days",
        "all 3 0.0 0.0 days",
    ]
    assert len(cache.entries()) == 3


@pytest.mark.parametrize("limit, left", [("unused_days=15", 2), ("max_gb=0.00001", 1)])
def test_limits_remove_what_is_unused(cli, cache, limit, left):
    code, out, _ = cli(f"cache_dir={cache.root}", limit, program=main)
    assert code == 0 and f"removed {3 - left} files, 0.0 MB" in out
    assert len(cache.entries()) == left and cache.has("shot", "a")


def test_damaged_files_are_removed(cli, cache):
    path = cache.path("spiral", "a")
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    code, out, err = cli(f"cache_dir={cache.root}", "verify=true", program=main)
    assert code == 0 and "1 damaged files removed" in out and "wrong checksum" in out + err
    assert not path.exists() and len(cache.entries()) == 2


@pytest.mark.parametrize(
    "word, message",
    [
        ("cache_dir=nowhere", "cache_dir must be a folder, got nowhere"),
        ("max_gb=-1", "max_gb must be at least 0, got -1"),
    ],
)
def test_a_mistake_is_one_line(cli, word, message):
    code, out, err = cli(word, program=main)
    [line] = (out + err).strip().splitlines()
    assert code == 1 and line == f"error: {message}"
