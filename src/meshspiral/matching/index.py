"""The index page of many matches: a thumbnail of each, the worst first."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import numpy as np

from meshspiral.data.files import write_file
from meshspiral.matching.writing import RESULT, THUMBNAIL
from meshspiral.viz.pages import fill_page

INDEX = "index.html"
UNSURE = 0.5  # a vertex with less confidence counts as unsure


class Entry(NamedTuple):
    """One match on the page.

    Attributes:
        name: Its folder's name.
        link: Its page, or its remarks where it has none.
        picture: Its thumbnail; None for none.
        median: The median confidence of its labelled vertices.
        unsure: The share of these below UNSURE.
    """

    name: str
    link: str
    picture: str | None
    median: float
    unsure: float


def write_index(folder: Path, names: Iterable[str], refused: Iterable[str]) -> None:
    """Write index.html.

    Args:
        folder: The folder of all matches.
        names: Names of the sources; those without a match are left out.
        refused: Reasons, one for each refused source.
    """
    found = filter(None, (read_entry(folder, name) for name in names))
    entries = sorted(found, key=lambda entry: (-entry.unsure, entry.median, entry.name))
    html = fill_page(
        Path(__file__).with_name(INDEX),
        title=f"{len(entries)} {'match' if len(entries) == 1 else 'matches'} in {folder.name}",
        entries=entries,
        refused=sorted(refused),
        pictured=any(entry.picture for entry in entries),
    )
    write_file(folder / INDEX, html)


def read_entry(folder: Path, name: str) -> Entry | None:
    """The entry of a match from its files; None without a complete match."""
    try:
        with np.load(folder / name / RESULT, allow_pickle=False) as file:
            kind = "map_confidence" if "map_confidence" in file else "near_confidence"
            confidence = file[kind][file["template"] >= 0]
    except (OSError, ValueError, KeyError):
        return None
    page = "view.html" if (folder / name / "view.html").exists() else "remarks.txt"
    picture = f"{quote(name)}/{THUMBNAIL}"
    has_picture = (folder / name / THUMBNAIL).exists()
    median = float(np.median(confidence)) if len(confidence) else 0.0
    unsure = float((confidence < UNSURE).mean()) if len(confidence) else 1.0
    return Entry(name, f"{quote(name)}/{page}", picture if has_picture else None, median, unsure)
