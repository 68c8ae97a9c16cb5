"""Progress of long work: a bar on a terminal, in a file or a pipe now and then a line."""

from __future__ import annotations

import logging
import re
import sys
import time
from typing import Any, TextIO

from tqdm import tqdm

EVERY = 10.0  # seconds between two lines of a file
LINE = "{desc}: {n_fmt}/{total_fmt}, {elapsed} elapsed, {remaining} left{postfix}"
CONTROL = re.compile(r"\x1b\[A|\r")  # what moves a terminal's cursor


class Progress(tqdm):
    """tqdm's bar, which stays in place on a terminal and in a notebook.

    Where the output goes to a file or a pipe, it prints lines without a bar: one every ten seconds,
    and none of work that is done before.

    Args:
        *args: Of tqdm.
        **options: Of tqdm, but for `file`: it is standard error.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        if not in_place(sys.stderr):
            options |= {"mininterval": EVERY, "miniters": 1, "bar_format": LINE}
            options["file"] = Lines(sys.stderr)
            options.setdefault("delay", 1.0)
        self._began, self._line = time.time(), 0.0
        super().__init__(*args, **options)

    def refresh(self, *args: Any, **options: Any) -> None:
        """Show the present state; in a file, once the next line is due."""
        if self.disable or in_place(sys.stderr):
            super().refresh(*args, **options)
            return
        now = time.time()
        due = self._line + self.mininterval, self._began + self.delay
        if now >= max(due):
            super().refresh(*args, **options)
            self._line = now


class Lines:
    """What tqdm writes into one place of a terminal, as lines of a file.

    Args:
        stream: The file.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> None:
        if text := CONTROL.sub("", text).strip():
            self._stream.write(text + "\n")

    def flush(self) -> None:
        self._stream.flush()


class ConsoleHandler(logging.StreamHandler):
    """A handler whose messages go above the bars that are shown."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            Progress.write(self.format(record), file=self.stream)
            self.flush()
        except Exception:  # as the base class does
            self.handleError(record)


def in_place(stream: TextIO) -> bool:
    """Whether a stream can be written over: on a terminal, and in a notebook."""
    return stream.isatty() or "ipykernel" in sys.modules
