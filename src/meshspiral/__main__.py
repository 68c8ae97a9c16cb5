"""The console script: `meshspiral <command> [key=value ...]`, also `python -m meshspiral`."""

from __future__ import annotations

import difflib
import runpy
import sys

COMMANDS = {
    "train": "train a network and test it",
    "evaluate": "test a finished run again",
    "match": "match meshes",
    "report": "show many runs on one page",
    "meshes": "list the meshes of a data set",
    "preprocess": "fill the cache for a data set",
    "cache": "show and bound the cache",
    "draw": "draw the neighbourhoods of a vertex",
    "benchmark": "measure what a training step costs",
    "doctor": "print what a bug report needs",
}


def main() -> None:
    """Run the command that the first word names, with the words after it."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in ("-h", "--help"):
        print("Usage: meshspiral <command> [key=value ...]\n")
        print("\n".join(f"  {command:<10} {what}" for command, what in COMMANDS.items()))
        print("\nSettings of a command: meshspiral <command> --help")
        return
    if name not in COMMANDS:
        close = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(COMMANDS)}"
        print(f"error: unknown command {name}; {hint}", file=sys.stderr)
        sys.exit(2)
    del sys.argv[1]
    # as `python -m` runs it: processes that start this program again find it by its module's name
    runpy.run_module(f"meshspiral.commands.{name}", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
