"""Sweeps that can be killed and started again: names of their folders, and a table at the end."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
import re
import sys
from functools import cache
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from meshspiral.experiment.runs import CONFIG, LAST, METRICS, in_use, is_first, write_whole

FAILED = "failed.txt"  # in the folder of a job that failed: why, in a line
COMMAND = "SPIRAL_COMMAND"  # in the environment: the words of the command line, for jobs elsewhere


def announce() -> None:
    """Have the jobs of this command line, in whatever process they run, know its words."""
    os.environ[COMMAND] = json.dumps(sys.argv[1:])
    _fresh.cache_clear()
    Table.folder, Table.failed = None, 0


def run_folder(resume: str | None, new: str) -> str:
    """A run's folder: that of the run to go on with, if it is there; else a new one."""
    return resume if resume and Path(resume).is_dir() else _fresh(new)


@cache
def _fresh(name: str) -> str:
    """A folder of that name that nobody else has, made for this command line: runs that are started
    at the same second get a number."""
    if not is_first():
        return name
    for number in itertools.count(1):
        folder = name if number == 1 else f"{name}_{number}"
        try:
            os.makedirs(folder)
        except FileExistsError:
            continue
        except OSError:  # Hydra will say so
            pass
        return folder


def sweep_folder() -> str:
    """A sweep's folder, named by its command line: the same command finds its jobs again."""
    words = json.loads(os.environ[COMMAND])
    words = [word for word in words if not re.match(r"[+~]*(-|hydra[./])", word)]
    return legal_name("_".join(word.lstrip("+") for word in words).replace("=", "-")) or "sweep"


def job_folder(overrides: list[str], number: int) -> str:
    """A job's folder in a sweep, named by the settings that the sweep varies.

    overrides: the job's own. Those that the command line gives one value are the same in every job.
    """
    parse = OverridesParser.create().parse_override
    fixed = set()
    for word in json.loads(os.environ[COMMAND]):
        with contextlib.suppress(HydraException):
            override = parse(word)
            if not override.is_sweep_override():
                fixed.add(override.key_or_group)
    varied = [o.lstrip("+") for o in overrides if parse(o).key_or_group not in fixed]
    varied = [re.sub("=(True|False)$", lambda x: x[0].lower(), o) for o in varied]  # of a file
    what = varied or [o.lstrip("+") for o in overrides]  # a sweep of one
    return legal_name("_".join(what).replace("=", "-")) or str(number)


def legal_name(name: str) -> str:
    legal = re.sub(r"[^\w.+-]+", "-", name).encode()[:120].decode(errors="ignore")
    if legal != name:  # what was lost may be what tells two of them apart
        legal += "-" + hashlib.sha256(name.encode()).hexdigest()[:8]
    return legal


def note_failure(folder: Path, reason: str | None) -> None:
    """Keep why a job failed, for the table; None: it has not, so far."""
    if reason is None:
        (folder / FAILED).unlink(missing_ok=True)
    else:
        with contextlib.suppress(OSError):
            write_whole(folder / FAILED, reason + "\n")


def states(folder: Path) -> list[tuple[str, str, str]]:
    """For each job of a sweep its folder, its state and its figures, or why it has none."""
    found = []
    for job in sorted(path for path in folder.iterdir() if path.is_dir()):
        reason = (job / FAILED).read_text().strip() if (job / FAILED).is_file() else None
        if (job / METRICS).is_file():
            metrics = json.loads((job / METRICS).read_text())
            exact, error = metrics["test/exact_match"], metrics["test/geodesic_error"]
            what = f"{100 * exact:.2f} % exact, error {error:.4f}"
            found.append((job.name, "finished", f"{what}; but {reason}" if reason else what))
        elif (job / CONFIG).is_file() and in_use(job):
            found.append((job.name, "running", "elsewhere"))
        elif reason:
            found.append((job.name, "failed", reason))
        elif (job / CONFIG).is_file():
            how = "goes on with the same command" if (job / LAST).is_file() else "no epoch yet"
            found.append((job.name, "stopped", how))
    return found


class Table(Callback):
    """At the end of a sweep, by Hydra's leave: what finished, what failed, and why.

    folder: of the latest sweep of this process. failed: how many of its jobs did.
    """

    folder: Path | None = None
    failed = 0

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        Table.folder = Path(config.hydra.sweep.dir)

    def on_multirun_end(self, **_: Any) -> None:
        Table.show()

    @staticmethod
    def show() -> None:
        """Print it, as far as there is one."""
        folder = Table.folder
        if folder is None or not folder.is_dir():
            return
        rows = states(folder)
        Table.failed = len(list(folder.glob(f"*/{FAILED}")))
        widths = [max([len(row[i]) for row in rows] or [0]) for i in range(2)]
        lines = [f"  {job:<{widths[0]}}  {state:<{widths[1]}}  {what}" for job, state, what in rows]
        print("\n".join([f"\nSweep {folder}:", *lines]))
        print(f"To see them all: python -m src.report runs={folder}")


# on import, since a launcher's processes import what their job needs, and no more
OmegaConf.register_new_resolver("run_folder", run_folder, replace=True)
OmegaConf.register_new_resolver("job_folder", job_folder, replace=True)
OmegaConf.register_new_resolver("sweep_folder", sweep_folder, replace=True)
