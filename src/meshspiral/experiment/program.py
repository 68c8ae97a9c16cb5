"""How this process was started: from a clone, or by the installed console script."""

from __future__ import annotations

import sys


def module_of(command: str) -> str:
    """The module to run for a command in another process, `python -m <module>`."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    installed = spec is not None and (spec.name or "").startswith("meshspiral")
    return f"meshspiral.commands.{command}" if installed else f"src.{command}"


def command_line(command: str) -> str:
    """What the user types to run a command."""
    clone = module_of(command).startswith("src")
    return f"python -m src.{command}" if clone else f"meshspiral {command}"
