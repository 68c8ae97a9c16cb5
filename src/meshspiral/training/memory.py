"""How this process keeps its memory."""

from __future__ import annotations

import contextlib
import ctypes


def keep_freed_memory() -> None:
    """Have the C library keep the memory of large tensors for the next ones of this process.

    It would give each back to the system, and every page of the next be cleared and mapped again,
    which takes a tenth of a step of LSTM-NET. Where the library is not GNU's, all stays as it is.
    """
    with contextlib.suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL("libc.so.6").mallopt
        mallopt(-4, 0)  # M_MMAP_MAX: large blocks come from the heap as well
        mallopt(-1, 2**31 - 1)  # M_TRIM_THRESHOLD: and the heap does not shrink
