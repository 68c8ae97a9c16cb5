"""What all entry points share: a config from Hydra, and one clear message for each mistake."""

from __future__ import annotations

import itertools
import logging
import os
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from meshspiral.data.shapes import DataError
from meshspiral.experiment.runs import RunError, Stopped, write_whole
from meshspiral.experiment.schema import ConfigError
from meshspiral.experiment.sweeps import Table, announce, note_failure
from meshspiral.geometry.mesh import MeshError

PACKAGE = Path(__file__).parents[1]
# in a clone conf/ is at its root; an installed package brings a copy
CONF = str(next(p for p in (PACKAGE.parents[1] / "conf", PACKAGE / "conf") if p.is_dir()))
USER_ERRORS = (
    ConfigError,
    DataError,
    MeshError,
    RunError,
    OSError,
    HydraException,
    OmegaConfBaseException,
)

log = logging.getLogger(__name__)


def entry_point(
    name: str, check: Callable[[DictConfig], DictConfig]
) -> Callable[[Callable[[DictConfig], None]], Callable[[], None]]:
    """Make `task(check(config))` a program with the config conf/<name>.yaml.

    A mistake of the user ends it with one message and exit code 1 (2 if the command line can't be
    read), Ctrl-C with 130 and SIGTERM with 143. Anything else is an error of ours and shows its
    traceback. In a sweep the jobs after a failed one still run.
    """

    def decorate(task: Callable[[DictConfig], None]) -> Callable[[], None]:
        failed: list[str] = []

        def job(config: DictConfig) -> None:
            hydra_ = HydraConfig.get()
            folder = Path(hydra_.runtime.output_dir) if hydra_.mode == RunMode.MULTIRUN else None
            if folder:
                note_failure(folder, None)
            try:
                task(check(config))
                return
            except USER_ERRORS as error:
                reason = one_line(error)
                log.error("error: %s", reason)
            except Exception as error:
                reason = repr(error)
                log.exception("error: this should not have happened")
            failed.append(reason)
            if folder:
                note_failure(folder, reason)

        def main() -> None:
            failed.clear()
            os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra hands errors on: we word them
            announce()
            signal.signal(signal.SIGTERM, _stop)
            signal.signal(signal.SIGINT, _stop)
            try:
                hydra.main(config_path=CONF, config_name=name, version_base="1.3")(job)()
            except Stopped as stopped:
                print(f"\n{stopped}", file=sys.stderr)
                sys.exit(128 + stopped.signum)
            except USER_ERRORS as error:
                print(f"error: {one_line(error)}", file=sys.stderr)
                sys.exit(2 if isinstance(error, HydraException) else 1)
            except Exception as error:  # of the launcher: a job that was killed, say
                if Table.folder is None:
                    raise
                Table.show()
                reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
                where = Table.folder / "traceback.txt"
                write_whole(where, traceback.format_exc())
                print(
                    f"error: a job came to no end ({reason}; traceback in {where}); "
                    "to go on: the same command",
                    file=sys.stderr,
                )
                sys.exit(1)
            if failed or Table.failed:
                sys.exit(1)

        return main

    return decorate


def _stop(signum: int, frame: object) -> None:
    again = " To go on: the same command" if Table.folder else ""
    raise Stopped(signum, f"Stopped.{again}")


def one_line(error: BaseException) -> str:
    """An error in one line, for Hydra's and the operating system's errors too."""
    if isinstance(error, HydraException | OmegaConfBaseException):
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        for i, line in enumerate(lines):
            if line.startswith("Available options in"):
                options = itertools.takewhile(lambda x: "search path" not in x, lines[i + 1 :])
                extra = "; others need pip install -e '.[parallel,cluster]'"
                hint = extra if "hydra/launcher" in lines[0] else ""
                return f"{lines[0]}; there are: {', '.join(options)}{hint}"
        if lines[0].startswith(("mismatched input", "token recognition", "no viable")):
            hint = "; a value with = or spaces needs quotes of its own: \"source='a b=c.ply'\""
            return lines[0] + hint
        cause = error.__cause__
        reason = f" ({str(cause).splitlines()[0]})" if cause is not None and str(cause) else ""
        return lines[0] + reason
    if type(error).__module__ == "builtins" and isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return str(error)
