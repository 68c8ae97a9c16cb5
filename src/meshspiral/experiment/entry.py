"""The entry point of all commands: a config from Hydra, and one message for each mistake."""

from __future__ import annotations

import difflib
import itertools
import logging
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import BaseModel

from meshspiral.data.files import write_file
from meshspiral.data.shapes import DataError
from meshspiral.experiment.compose import CONF, known_keys
from meshspiral.experiment.help import settings_help
from meshspiral.experiment.program import command_line
from meshspiral.experiment.quoting import quote_words
from meshspiral.experiment.run_folder import RunError, Stopped
from meshspiral.experiment.schema import MOVED, ConfigError, read_config
from meshspiral.experiment.sweeps import invocation, note_failure, number_unfinished, show_table
from meshspiral.geometry.mesh import MeshError

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
Config = TypeVar("Config", bound=BaseModel)


def entry_point(
    name: str,
    schema: type[Config],
    rewrite: Callable[[list[str]], list[str]] = list,
) -> Callable[[Callable[[Config], None]], Callable[[], None]]:
    """Make a function of a config a program, with the composed config of conf/<name>.yaml.

    A mistake of the user ends the program with one message and exit code 1, or 2 if the command
    line cannot be parsed; Ctrl-C with 130 and SIGTERM with 143. Any other exception is a bug and
    shows its traceback. A failed job of a sweep does not stop the other jobs.

    Args:
        name: Name of the command.
        schema: The type of the config.
        rewrite: Turns the words of the command line into those that Hydra reads.
    """

    def decorate(task: Callable[[Config], None]) -> Callable[[], None]:
        def main() -> None:
            failed: list[str] = []
            logging.raiseExceptions = False  # a full disk is reported once, not by each message
            os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra raises errors; we word them
            signal.signal(signal.SIGTERM, _stop)
            signal.signal(signal.SIGINT, _stop)
            if hint := dashed_setting(sys.argv[1:], schema):
                print(f"error: {hint}", file=sys.stderr)
                sys.exit(2)
            sys.argv[1:] = quote_words(rewrite(sys.argv[1:]), schema)
            with invocation(sys.argv[1:]) as call:
                try:

                    def job(config: DictConfig) -> None:
                        _run_job(task, schema, failed, config)

                    hydra.main(config_path=CONF, config_name=name, version_base="1.3")(job)()
                except Stopped as stopped:
                    again = " To resume: rerun the same command" if call.sweep else ""
                    print(f"\n{stopped}{again}", file=sys.stderr)
                    sys.exit(128 + stopped.signum)
                except USER_ERRORS as error:
                    print(
                        f"error: {unknown_setting(name, error) or one_line(error)}", file=sys.stderr
                    )
                    sys.exit(2 if isinstance(error, HydraException) else 1)
                except Exception as error:
                    if "Config group override" in str(error):  # Hydra's, for model=null
                        words = [word for word in sys.argv[1:] if word.endswith("=null")]
                        message = f"{' '.join(words)}: a config group must be one of its options"
                        print(f"error: {message}; --help lists them", file=sys.stderr)
                        sys.exit(2)
                    if call.sweep is None:
                        raise
                    # of the launcher, e.g. because a job was killed
                    show_table(call.sweep)
                    reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
                    where = call.sweep / "traceback.txt"
                    write_file(where, traceback.format_exc())
                    print(
                        f"error: a job crashed ({reason}; traceback in {where}); "
                        "rerun the same command to resume",
                        file=sys.stderr,
                    )
                    sys.exit(1)
                if failed or (call.sweep and number_unfinished(call.sweep)):
                    sys.exit(1)

        return main

    return decorate


def _run_job(
    task: Callable[[Config], None], schema: type[Config], failed: list[str], config: DictConfig
) -> None:
    """Run a command with one config: the only one, or a job of a sweep."""
    hydra_ = HydraConfig.get()
    folder = Path(hydra_.runtime.output_dir) if hydra_.mode == RunMode.MULTIRUN else None
    if folder:
        note_failure(folder, None)
    try:
        settings = read_config(schema, config)
        lengths = [
            word for word in hydra_.overrides.task if word.lstrip("+").startswith("seq_len=")
        ]
        neighbourhood = getattr(settings, "neighbourhood", None)
        if lengths and neighbourhood and "seq_len" not in type(neighbourhood).model_fields:
            log.info("%s: ignored, does not apply to %s", lengths[-1], neighbourhood.name)
        task(settings)
        return
    except USER_ERRORS as error:
        reason = one_line(error)
        log.error("error: %s", reason)
    except Exception as error:
        reason = repr(error)
        log.exception("error: unexpected exception, please report it")
    failed.append(reason)
    if folder:
        note_failure(folder, reason)


def dashed_setting(words: list[str], schema: type[BaseModel]) -> str | None:
    """What to type instead of the first word such as --seed=1 or --seed 1, if there is one."""
    for i, word in enumerate(words):
        name, _, value = word.removeprefix("--").partition("=")
        if word.startswith("--") and name in schema.model_fields:
            value = value or (words[i + 1] if i + 1 < len(words) else "...")
            return f"{word} is not an option; settings have no dashes: {name}={value}"
    return None


def unknown_setting(command: str, error: BaseException) -> str | None:
    """A message with the closest known setting, if Hydra does not know one; None otherwise."""
    unknown = re.search(r"Could not override '[+~]*([^']+)'", str(error))
    if unknown is None or any(unknown[1].startswith(old) for old in MOVED):
        return None
    known = known_keys(command)
    if unknown[1] in known:
        group = unknown[1].partition(".")[0]
        return (
            f"{unknown[1]} is a setting of other options of {group} than the chosen one; "
            f"{command_line(command)} --help says of which"
        )
    close = difflib.get_close_matches(unknown[1], known, n=1)
    hint = f"did you mean {close[0]}?" if close else f"{command_line(command)} --help lists them"
    return f"unknown setting {unknown[1]}; {hint}"


def _stop(signum: int, frame: object) -> None:
    raise Stopped(signum)


def one_line(error: BaseException) -> str:
    """An error in one line, also one of Hydra or of the operating system."""
    if isinstance(error, HydraException | OmegaConfBaseException):
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        for i, line in enumerate(lines):
            if line.startswith("Available options in"):
                rest = itertools.takewhile(lambda x: "search path" not in x, lines[i + 1 :])
                options = list(rest)
                extra = "; others need pip install hydra-joblib-launcher hydra-submitit-launcher"
                hint = extra if "hydra/launcher" in lines[0] else ""
                missing = lines[0].rstrip("'").rpartition("/")[2]
                close = difflib.get_close_matches(missing, options, n=1)
                which = f"did you mean {close[0]}? There are" if close else "there are"
                return f"{lines[0]}; {which}: {', '.join(options)}{hint}"
        if lines[0].startswith(("mismatched input", "token recognition", "no viable")):
            hint = "; a value with = or spaces needs quotes of its own: \"source='a b=c.ply'\""
            return lines[0] + hint
        if ambiguous := re.match(r"Ambiguous value for argument '(([^=]+)=(.*))'$", lines[0]):
            word, key, value = ambiguous.groups()
            return (
                f"{word} is several values; as one value: \"{key}='{value}'\", as a list: "
                f"'{key}=[{value}]', as a sweep: -m {word}"
            )
        if lines[0].startswith("Interpolation key"):
            return lines[0] + "; where ${ is part of a name, write \\${"
        for old, new in MOVED.items():
            if f"'{old}" in lines[0]:
                return f"{lines[0]} {old} is {new} now"
        cause = error.__cause__
        reason = f" ({str(cause).splitlines()[0]})" if cause is not None and str(cause) else ""
        return lines[0] + reason
    if type(error).__module__ == "builtins" and isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    if from_reader := re.match(r"Caught (\w+) in DataLoader worker", text := str(error)):
        return text.rpartition(f"{from_reader[1]}: ")[2].strip()  # the traceback is above it
    return str(error)


OmegaConf.register_new_resolver(
    "settings_help", lambda command: settings_help(command, Path(CONF)), replace=True
)
