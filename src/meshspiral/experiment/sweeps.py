"""Sweeps that can be killed and resumed: names of their folders, and a table at the end."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from meshspiral.data.files import legal_name, write_file
from meshspiral.experiment.program import command_line
from meshspiral.experiment.run_folder import CONFIG, LAST, METRICS
from meshspiral.experiment.runs import is_first, is_locked

FAILED = "failed.txt"  # in the folder of a failed job: the reason, in one line
COMMAND = "MESHSPIRAL_COMMAND"  # environment variable: the words of the command line


@dataclass
class Invocation:
    """One call of a command.

    Attributes:
        sweep: Folder of its sweep, if it is one.
        folders: Folders that it has created for its runs, by the name that was asked for.
    """

    sweep: Path | None = None
    folders: dict[str, str] = field(default_factory=dict)


_current: ContextVar[Invocation | None] = ContextVar("invocation", default=None)


@contextlib.contextmanager
def invocation(words: list[str]) -> Iterator[Invocation]:
    """While a command runs: its state, for the functions that Hydra calls.

    Args:
        words: The command line. Jobs in other processes find it in the environment.
    """
    os.environ[COMMAND] = json.dumps(words)
    token = _current.set(Invocation())
    try:
        yield _current.get()
    finally:
        _current.reset(token)


def run_folder(resume: str | None, new: str) -> str:
    """The folder of a run: that of the run to resume if it exists, else a new one."""
    if resume and Path(resume).is_dir():
        return resume
    call = _current.get()
    if call is None or not is_first():
        return new
    if new not in call.folders:  # Hydra asks several times
        call.folders[new] = _new_folder(new)
    return call.folders[new]


def _new_folder(name: str) -> str:
    """Create a folder of that name; runs that start in the same second get a number."""
    for number in itertools.count(1):
        folder = name if number == 1 else f"{name}_{number}"
        try:
            os.makedirs(folder)
        except FileExistsError:
            continue
        except OSError:  # Hydra will report it
            pass
        return folder


def sweep_folder() -> str:
    """The folder of a sweep, named by its command line: the same command finds its jobs again."""
    words = json.loads(os.environ[COMMAND])
    words = [word for word in words if not re.match(r"[+~]*(-|hydra[./])", word)]
    return _folder_name(words) or "sweep"


def job_folder(overrides: list[str], number: int) -> str:
    """The folder of a job in a sweep, named by the settings that the sweep varies.

    Args:
        overrides: The job's own. Those with one value on the command line are equal in all jobs.
        number: The job's number, its name if it has no overrides.
    """
    parse = OverridesParser.create().parse_override
    fixed = set()
    for word in json.loads(os.environ[COMMAND]):
        with contextlib.suppress(HydraException):
            override = parse(word)
            if not override.is_sweep_override():
                fixed.add(override.key_or_group)
    varied = [o.lstrip("+") for o in overrides if parse(o).key_or_group not in fixed]
    # an experiment file's True is the command line's true
    varied = [re.sub("=(True|False)$", lambda x: x[0].lower(), o) for o in varied]
    return _folder_name(varied or overrides) or str(number)  # a sweep of one job varies nothing


def _folder_name(words: list[str]) -> str:
    """data/remesh=mixed +metric=true as data.remesh-mixed_metric-true."""
    pairs = (word.lstrip("+").partition("=") for word in words)
    return legal_name(
        "_".join(
            key.replace("/", ".") + "-" * bool(equals) + value.replace("=", "-")
            for key, equals, value in pairs
        )
    )


def note_failure(folder: Path, reason: str | None) -> None:
    """Store why a job failed, for the table; None: remove the note of an earlier attempt."""
    if reason is None:
        (folder / FAILED).unlink(missing_ok=True)
    else:
        with contextlib.suppress(OSError):
            write_file(folder / FAILED, reason + "\n")


def number_unfinished(folder: Path) -> int:
    """How many jobs of a sweep failed, or were stopped and are not running in another process."""
    stopped = [row for row in job_states(folder) if row[1] == "stopped"]
    return len(list(folder.glob(f"*/{FAILED}"))) + len(stopped)


def job_states(folder: Path) -> list[tuple[str, str, str]]:
    """For each job of a sweep its folder, its state, and its metrics or the reason of a failure."""
    rows = []
    for job in sorted(path for path in folder.iterdir() if path.is_dir()):
        reason = (job / FAILED).read_text().strip() if (job / FAILED).is_file() else None
        if (job / METRICS).is_file():
            metrics = json.loads((job / METRICS).read_text())
            exact, error = metrics["test/exact_match"], metrics["test/geodesic_error"]
            what = f"{100 * exact:.2f} % exact, error {error:.4f}"
            rows.append((job.name, "finished", f"{what}; but {reason}" if reason else what))
        elif (job / CONFIG).is_file() and is_locked(job):
            rows.append((job.name, "running", "in another process"))
        elif reason:
            rows.append((job.name, "failed", reason))
        elif (job / CONFIG).is_file():
            how = "the same command resumes it" if (job / LAST).is_file() else "no epoch finished"
            rows.append((job.name, "stopped", how))
    return rows


def show_table(folder: Path) -> None:
    """Print the state of every job of a sweep."""
    if not folder.is_dir():
        return
    rows = job_states(folder)
    widths = [max([len(row[i]) for row in rows] or [0]) for i in range(2)]
    lines = [f"  {job:<{widths[0]}}  {state:<{widths[1]}}  {what}" for job, state, what in rows]
    print("\n".join([f"\nSweep {folder}:", *lines]))
    print(f"All runs on one page: {command_line('report')} runs={folder}")


class Table(Callback):
    """Prints the table at the end of a sweep; Hydra creates and calls it."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        if (call := _current.get()) is not None:
            call.sweep = Path(config.hydra.sweep.dir)

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        show_table(Path(config.hydra.sweep.dir))


# on import: processes of a launcher import what their job needs, and no more
OmegaConf.register_new_resolver("run_folder", run_folder, replace=True)
OmegaConf.register_new_resolver("job_folder", job_folder, replace=True)
OmegaConf.register_new_resolver("sweep_folder", sweep_folder, replace=True)
