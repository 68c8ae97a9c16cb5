"""Rows of measurements as text."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from meshspiral.benchmarking.measure import Row


def table_lines(title: str, rows: list[Row]) -> Iterator[str]:
    """A title, and a table with one column for each key of the rows."""
    yield f"\n{title}"
    cells = [list(rows[0]), *([format_value(value) for value in row.values()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for first, *others in cells:
        aligned = [cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True)]
        yield "  ".join(["", first.ljust(widths[0]), *aligned]).rstrip()


def format_value(value: Any) -> str:
    """A number with three decimals, or with none from 100 on; "-" for None."""
    if isinstance(value, list | tuple):
        return " ".join(map(format_value, value))
    if value is None:
        return "-"
    return f"{value:,.{0 if value >= 100 else 3}f}" if isinstance(value, float) else str(value)
