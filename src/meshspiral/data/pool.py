"""Work in a pool of worker processes, by joblib's loky backend."""

from __future__ import annotations

import contextlib
import os
import random
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from typing import Any

from joblib import Parallel, cpu_count, delayed, effective_n_jobs, parallel_config
from joblib.externals.loky.process_executor import TerminatedWorkerError
from joblib.parallel import get_active_backend

from meshspiral.data.progress import Progress
from meshspiral.data.shapes import DataError

POOL_START = 6.0  # seconds that starting the worker processes takes
LARGEST_JOB = 16  # items
CONNECT = 10.0  # seconds to wait for a scheduler's answer


def run_all(
    function: Callable[[Any], Any], items: Sequence[Any], workers: int | None, description: str
) -> list[Any]:
    """The results of a function for all items, with a progress bar.

    The order of the calls is random and differs between processes, so that jobs of a sweep that
    start together share the work. Worker processes are started only if the remaining work would
    take longer than starting them.

    Args:
        function: Picklable.
        items: Its arguments.
        workers: Number of processes; None for one per core.
        description: Label of the progress bar.

    Raises:
        DataError: A worker process was killed.
    """
    order = list(range(len(items)))
    random.Random().shuffle(order)
    cluster = _is_on_cluster()
    workers = effective_n_jobs(-1) if cluster else min(workers or cpu_count(), len(items))
    results: list[Any] = [None] * len(items)
    with Progress(total=len(items), desc=description, unit="mesh", delay=1.0) as progress:
        started = None
        for done, i in enumerate(order):
            is_long = cluster
            if workers > 1 and done > 1:
                each = (time.perf_counter() - started) / (done - 1)
                is_long = each * (len(items) - done) > POOL_START
            if is_long:
                rest = order[done:]
                # few jobs of several items: the function may be large when it is pickled
                size = max(1, min(LARGEST_JOB, len(rest) // (8 * workers)))
                parts = [rest[k : k + size] for k in range(0, len(rest), size)]
                jobs = ((function, part, [items[k] for k in part]) for part in parts)
                for part, found in run_in_pool(_run_part, jobs, workers, "data.workers=1"):
                    for k, result in zip(part, found, strict=True):
                        results[k] = result
                    progress.update(len(part))
                return results
            results[i] = function(items[i])
            progress.update()
            started = started or time.perf_counter()  # after the first, which compiles
    return results


def _run_part(
    function: Callable[[Any], Any], part: list[int], items: list[Any]
) -> tuple[list[int], list[Any]]:
    return part, [function(item) for item in items]


@contextlib.contextmanager
def on_cluster(scheduler: str | None) -> Iterator[None]:
    """Let the workers of a Dask cluster run what `run_all` would run in processes.

    Args:
        scheduler: Address of its scheduler; None for processes on this machine.

    Raises:
        DataError: Dask is not installed, or there is no scheduler.
    """
    if scheduler is None:
        yield
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise DataError("scheduler= needs Dask: pip install 'dask[distributed]'") from error
    try:
        client = Client(scheduler, timeout=CONNECT)
    except (OSError, ValueError) as error:
        raise DataError(f"scheduler={scheduler}: no Dask scheduler answers there") from error
    with client, parallel_config("dask", client=client):
        yield


def _is_on_cluster() -> bool:
    return "Dask" in type(get_active_backend()[0]).__name__


def run_in_pool(
    function: Callable[..., Any], jobs: Iterable[tuple], workers: int, setting: str
) -> Iterator[Any]:
    """Yield `function(*job)` of every job, in the order in which they finish.

    Args:
        function: Picklable.
        jobs: The arguments of each call.
        workers: Number of processes.
        setting: The setting that reduces `workers`, for the error message, e.g. `data.workers=1`.

    Raises:
        DataError: A worker was killed.
    """
    cluster = _is_on_cluster()
    # by default idle workers keep their memory for five minutes
    options = {} if cluster else {"idle_worker_timeout": 2}
    pool = Parallel(n_jobs=workers, return_as="generator_unordered", **options)
    parent = None if cluster else os.getpid()
    try:
        yield from pool(delayed(_call)(parent, function, *job) for job in jobs)
    except Exception as error:
        killed = isinstance(error, TerminatedWorkerError) or type(error).__name__ == "KilledWorker"
        if not killed:
            raise
        raise DataError(
            f"a worker process was killed, probably out of memory; {setting} needs less memory; "
            "rerun the same command to resume"
        ) from error


def _call(parent: int | None, function: Callable[..., Any], *job: Any) -> Any:
    """Run a job, in a worker that ends when the process that started the pool is killed.

    The workers of a cluster, with `parent` None, do not end.
    """
    if parent not in (None, os.getpid()):  # with one worker, joblib runs jobs in the process itself
        _end_with(parent)
    return function(*job)


@cache
def _end_with(parent: int) -> None:
    """Watch the parent process; once per worker."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
