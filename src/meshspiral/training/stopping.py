"""Ctrl-C and SIGTERM."""

from __future__ import annotations


class Stopped(BaseException):
    """The program was asked to stop, by Ctrl-C or SIGTERM.

    Args:
        signum: Number of the signal.
        message: What to tell the user, e.g. how to resume.
    """

    def __init__(self, signum: int, message: str = "Stopped."):
        super().__init__(message)
        self.signum = signum
