"""Progress: in place on a terminal, lines in a file, messages above the bars."""

from __future__ import annotations

import io
import logging
import re
import sys
import time

import pytest

from meshspiral.data import progress
from meshspiral.data.progress import ConsoleHandler, Progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def every(monkeypatch):
    monkeypatch.setattr(progress, "EVERY", 0.05)


def work(**options) -> None:
    for _ in Progress(range(8), desc="Meshes", **options):
        time.sleep(0.02)


@pytest.mark.parametrize("leave", [True, False])
def test_a_file_gets_lines_without_bars(monkeypatch, every, leave):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    work(delay=0.01, leave=leave, bar_format="{bar}")
    text = sys.stderr.getvalue()
    assert "\r" not in text and "\x1b" not in text and text.endswith("\n")
    lines = text.splitlines()
    assert 1 <= len(lines) <= 5
    assert all(line.startswith("Meshes: ") and line.endswith(" left") for line in lines)
    assert (lines[-1].startswith("Meshes: 8/8, ")) == leave


def test_short_work_leaves_a_file_empty(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with Progress(total=2) as bar:
        for stage in ("reading", "labelling"):
            bar.set_description_str(stage)
            bar.update()
    assert sys.stderr.getvalue() == ""


def test_a_description_waits_for_the_next_line(monkeypatch, every):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    began = time.monotonic()
    with Progress(total=9, delay=0.01, leave=False) as bar:
        for stage in range(9):
            bar.set_description_str(f"stage {stage}")
            time.sleep(0.02)
    lines = sys.stderr.getvalue().count("\n")
    assert 1 <= lines <= (time.monotonic() - began) / 0.05 + 1


def test_lines_count_what_is_done(monkeypatch, every):
    """Also where something else shows the bar in between, as tqdm's monitor does."""
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    done = 0
    bar = Progress(range(40), delay=0)
    for i in bar:
        time.sleep(0.005)
        bar.refresh()
        done = i + 1
    counts = re.findall(r"(\d+)/40", sys.stderr.getvalue())
    assert done == 40 == int(counts[-1]) and len(counts) >= 3
    assert list(map(int, counts)) == sorted(map(int, counts))
    assert "?" not in sys.stderr.getvalue().rpartition("40/40")[2]


def test_a_terminal_gets_one_bar_in_place(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    work(mininterval=0)
    text = sys.stderr.getvalue()
    assert text.count("\n") == 1 and text.count("\r") >= 8 and "8/8" in text


def test_messages_go_above_the_bar(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setattr(sys, "stdout", sys.stderr)  # both on one screen
    log = logging.Logger("table")
    log.addHandler(ConsoleHandler(sys.stdout))
    with Progress(total=2, desc="Meshes", ncols=40) as bar:
        bar.update()
        log.info("a row")
        bar.update()
    before, _, after = sys.stderr.getvalue().partition("a row\n")
    assert before.endswith("\r") and before.rsplit("\r", 2)[1].strip() == ""  # the bar is wiped
    assert "Meshes" in after
