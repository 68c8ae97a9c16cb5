"""A pool of worker processes, by joblib's loky backend."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from typing import Any

from joblib import Parallel, delayed
from joblib.externals.loky.process_executor import TerminatedWorkerError

from meshspiral.data.shapes import DataError


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
    # By default idle workers keep their memory for five minutes.
    pool = Parallel(n_jobs=workers, return_as="generator_unordered", idle_worker_timeout=2)
    try:
        yield from pool(delayed(_call)(os.getpid(), function, *job) for job in jobs)
    except TerminatedWorkerError as error:
        raise DataError(
            f"a worker process was killed, probably out of memory; {setting} needs less memory; "
            "rerun the same command to resume"
        ) from error


def _call(parent: int, function: Callable[..., Any], *job: Any) -> Any:
    """Run a job, in a worker that ends when the process that started the pool is killed."""
    if os.getpid() != parent:  # with one worker, joblib runs jobs in the process itself
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
