"""A pool of worker processes."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import pytest

from meshspiral.data.pool import run_in_pool
from tests.helpers import clone_environment, start, wait_for

SCRIPT = """
import os, sys, time
from pathlib import Path
from meshspiral.data.pool import run_in_pool

def note_and_sleep(folder):
    Path(folder, str(os.getpid())).touch()
    time.sleep(300)

list(run_in_pool(note_and_sleep, [(sys.argv[1],)] * 4, 2, "workers=1"))
"""


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    except OSError:
        return False


def test_results_come_as_they_are_finished():
    assert sorted(run_in_pool(abs, [(-1,), (-2,), (3,)], 2, "workers=1")) == [1, 2, 3]
    assert list(run_in_pool(abs, [(-1,)], 1, "workers=1")) == [1]


@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="finds processes in /proc")
def test_workers_end_soon_after_their_parent_was_killed(tmp_path):
    process = start([sys.executable, "-c", SCRIPT, str(tmp_path)], env=clone_environment())
    wait_for(lambda: len(list(tmp_path.iterdir())) == 2, process)
    workers = [int(path.name) for path in tmp_path.iterdir()]
    assert all(map(alive, workers))
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    end = time.monotonic() + 15
    while any(map(alive, workers)):
        assert time.monotonic() < end, "orphaned workers"
        time.sleep(0.1)
