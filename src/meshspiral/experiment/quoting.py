"""Quotes around values of the command line that Hydra's grammar would refuse or split.

Paths are what users type most, and brackets, quotes, commas, parentheses, braces, = or é in them
have no other meaning to these commands.
"""

from __future__ import annotations

import os
import re
from typing import Any, get_args

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, QuotedString
from hydra.errors import HydraException
from pydantic import BaseModel

from meshspiral.data.settings import Text

MULTIRUN = ("-m", "--multirun")


def quote_words(words: list[str], schema: type[BaseModel]) -> list[str]:
    """The words of a command line, with quotes where Hydra needs them.

    A value is quoted if Hydra cannot parse it. That of a text setting, such as a path, is also
    quoted if Hydra would read anything but the text; that of another setting if it would be several
    values, and names an existing file. Commas still separate the values of a sweep (-m).

    Args:
        words: The words; those that are no key=value stay as they are.
        schema: Settings of the command; its text settings are those of type `Text`.
    """
    sweep = any(word in MULTIRUN for word in words)
    text = {name for name, field in schema.model_fields.items() if _is_text(field.annotation)}
    return [_quote_word(word, text, sweep) for word in words]


def quote(value: str) -> str:
    """A value in single quotes, which Hydra reads as this text."""
    escaped = re.sub(r"(\\*)'", r"\1\1\\'", value)
    trailing = len(escaped) - len(escaped.rstrip("\\"))
    return f"'{escaped}{trailing * chr(92)}'"


def _is_text(annotation: Any) -> bool:
    return annotation is str or Text in get_args(annotation)


def _quote_word(word: str, text: set[str], sweep: bool) -> str:
    key, equals, value = word.partition("=")
    if not equals or not value or not re.fullmatch(r"[+~]*\w[\w./@-]*", key):
        return word
    override = _parse(word)
    if override is None:
        return f"{key}={_quote_parts(os.path.expanduser(value), sweep)}"
    several = override.is_sweep_override() and not sweep
    if key.lstrip("+") in text:
        parsed = override.value()
        verbatim = parsed is None or parsed == value or isinstance(override._value, QuotedString)
        if (not verbatim and not override.is_sweep_override()) or several:
            return f"{key}={quote(value)}"
        if "${" in value and os.path.exists(value):  # else an interpolation
            return f"{key}={quote(value.replace('${', chr(92) + '${'))}"
    elif several and os.path.exists(value):
        return f"{key}={quote(value)}"
    return word


def _quote_parts(value: str, sweep: bool) -> str:
    """Quote what cannot be parsed: items of a list, values of a sweep, or the whole value."""
    if value.startswith("[") and value.endswith("]"):
        quoted = "[" + _quote_items(value[1:-1]) + "]"
    elif sweep:
        quoted = _quote_items(value)
    else:
        return quote(value)
    return quoted if _parse(f"x={quoted}") else quote(value)


def _quote_items(items: str) -> str:
    return ",".join(
        item if _parse(f"x={item}") else quote(item.strip()) for item in items.split(",")
    )


def _parse(word: str) -> Override | None:
    """The word as Hydra reads it; None if it cannot."""
    try:
        return OverridesParser.create().parse_override(word)
    except HydraException:
        return None
