"""A pool of worker processes, by joblib's loky backend."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
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
    # By default idle workers keep their memory for five minutes after this process is killed.
    pool = Parallel(n_jobs=workers, return_as="generator_unordered", idle_worker_timeout=2)
    try:
        yield from pool(delayed(function)(*job) for job in jobs)
    except TerminatedWorkerError as error:
        raise DataError(
            f"a worker process was killed, probably out of memory; {setting} needs less memory; "
            "rerun the same command to resume"
        ) from error
