"""Seconds and bytes of actions, and the machine that they are measured on."""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_all_start_methods, get_context
from pathlib import Path
from typing import Any

import torch

from meshspiral.training.device import choose_precision
from meshspiral.training.memory import bytes_in

Action = Callable[[], object]
Row = dict[str, Any]  # a row of a table: columns by name


def medians(actions: dict[str, Action], repeats: int, device: str = "cpu") -> dict[str, float]:
    """Time actions in turn, so that a change of the machine's speed affects all of them.

    Args:
        actions: By name.
        repeats: Number of timed rounds; an untimed round comes before them.
        device: The device on which the actions run, "cpu" or "cuda".

    Returns:
        The median of the seconds of each action.
    """
    seconds: dict[str, list[float]] = {name: [] for name in actions}
    for turn in range(repeats + 1):
        for name, action in actions.items():
            _synchronize(device)
            began = time.perf_counter()
            action()
            _synchronize(device)
            if turn:
                seconds[name].append(time.perf_counter() - began)
    return {name: statistics.median(values) for name, values in seconds.items()}


def _synchronize(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def in_own_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in a fresh process, whose memory nothing else has used.

    Args:
        function: Picklable, as its arguments are.

    Returns:
        What the function returns.

    Raises:
        ChildProcessError: The process was killed.
    """
    # forkserver imports once for all processes; with spawn each would take 8 s to import
    server = "forkserver" in get_all_start_methods()
    context = get_context("forkserver" if server else "spawn")
    if server:
        context.set_forkserver_preload(["meshspiral.benchmarking.scaling"])
    try:
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            return pool.submit(function, *arguments).result()
    except BrokenProcessPool as error:
        raise ChildProcessError(
            "a measured process was killed, probably out of memory; choose fewer models or parts"
        ) from error


def peak_bytes(action: Action) -> int | None:
    """Run an action and measure the largest growth of this process's memory meanwhile.

    Memory that earlier work of this process freed is returned to the system first; otherwise the
    action could use it unseen.

    Returns:
        The growth in bytes; None on systems other than Linux, where it is not measured.
    """
    status = Path("/proc/self/status")
    if not status.exists():
        action()
        return None
    with contextlib.suppress(OSError, AttributeError):  # a C library other than GNU's
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")  # reset the peak, VmHWM
    before = bytes_in(status, "VmRSS")
    action()
    return bytes_in(status, "VmHWM") - before


def machine() -> dict[str, Any]:
    """The processor, threads and software of this process."""
    processor = platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        found = [line for line in cpuinfo.read_text().splitlines() if "model name" in line]
        processor = found[0].split(":")[1].strip() if found else processor
    return {
        "processor": processor,
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "bf16": choose_precision("auto", "cpu") == "bf16-mixed",
        "torch": torch.__version__,
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }
