"""Matching many mesh files in several processes, each into a folder of its own."""

from __future__ import annotations

import glob
import logging
import os
from pathlib import Path
from typing import NamedTuple

import torch
from joblib import cpu_count

from meshspiral.data.files import legal_name
from meshspiral.data.mesh_files import SUFFIXES
from meshspiral.data.pool import run_in_pool
from meshspiral.data.progress import Progress
from meshspiral.data.shapes import DataError
from meshspiral.geometry.mesh import MeshError
from meshspiral.matching.job import MatchJob
from meshspiral.matching.pair import match_file
from meshspiral.matching.writing import is_finished
from meshspiral.viz.render import RenderError

log = logging.getLogger(__name__)


class BatchResult(NamedTuple):
    """What became of the sources of a batch.

    Attributes:
        matched: Number of sources matched, without those that were finished before.
        repaired: Number of these that were repaired.
        refused: For the path of each refused source, the reason.
    """

    matched: int
    repaired: int
    refused: dict[str, str]


class SourceResult(NamedTuple):
    """What became of one source; `refusal` is the reason if it was refused."""

    path: str
    refusal: str | None
    repaired: bool


def match_batch(
    job: MatchJob, sources: dict[str, str], folder: Path, workers: int | None
) -> BatchResult:
    """Match sources, except those that are finished. A source that cannot be used is refused.

    So is one whose files cannot be written.

    Args:
        job: What the sources share.
        sources: Paths by name, see `find_sources`.
        folder: The match of a source is written to the folder of its name in here.
        workers: Number of processes; None for one per core.

    Raises:
        DataError: A worker process was killed.
    """
    waiting = {
        name: path for name, path in sources.items() if not is_finished(job, path, folder / name)
    }
    if finished := len(sources) - len(waiting):
        log.info("%d of %d meshes are already matched", finished, len(sources))
    workers = min(workers or cpu_count(), max(1, len(waiting)))
    tasks = ((job, path, folder / name, workers) for name, path in waiting.items())
    results = run_in_pool(_match_source, tasks, workers, "workers=1")
    refused: dict[str, str] = {}
    repaired = 0
    for result in Progress(results, total=len(waiting), desc="Matching", unit="mesh"):
        repaired += result.repaired
        if result.refusal:
            refused[result.path] = result.refusal
            Progress.write(f"refused: {result.refusal}")
    return BatchResult(len(waiting) - len(refused), repaired, refused)


def _match_source(job: MatchJob, path: str, folder: Path, processes: int) -> SourceResult:
    """`match_file` in one of several processes."""
    if processes > 1:
        torch.set_num_threads(1)
    try:
        match = match_file(job, path, folder)
    except (MeshError, DataError, RenderError) as error:
        reason = str(error)
    except OSError as error:
        reason = f"{error.filename}: {error.strerror}" if error.filename else str(error)
    else:
        return SourceResult(path, None, match.source.scan.repaired)
    return SourceResult(path, reason if path in reason else f"{path}: {reason}", False)


def find_sources(pattern: str, output: Path) -> dict[str, str]:
    """The mesh files that match a pattern, by names that differ.

    A file's name is its path below the folder that all files share, with _ between folders; its
    suffix is part of the name only where names would be equal without it.

    Args:
        pattern: As for `glob.glob`; ** matches folders at any depth. Or a folder: all files in it.
            Or a file, whatever characters its name has.
        output: Files in this folder are left out: they are results.

    Returns:
        Paths by name, in the order of the paths.

    Raises:
        DataError: No mesh file matches.
    """
    matches = pattern
    if os.path.exists(pattern):  # a name with brackets is no pattern
        matches = glob.escape(pattern)
        matches = os.path.join(matches, "*") if os.path.isdir(pattern) else matches
    paths = sorted(
        path
        for path in glob.glob(matches, recursive=True)
        if path.lower().endswith(SUFFIXES)
        and os.path.isfile(path)
        and not Path(path).resolve().is_relative_to(output.resolve())
    )
    if not paths:
        raise DataError(f"sources: no mesh file ({', '.join(SUFFIXES)}) matches {pattern!r}")
    files: dict[str, str] = {}  # a symbolic link must not make two sources of one file
    for path in sorted(paths, key=len):
        files.setdefault(os.path.realpath(path), path)
    paths = sorted(files.values())
    shared = os.path.commonpath([os.path.dirname(os.path.abspath(path)) for path in paths])
    names = [os.path.relpath(os.path.abspath(path), shared).replace(os.sep, "_") for path in paths]
    stems = [os.path.splitext(name)[0] for name in names]
    sources: dict[str, str] = {}
    for stem, name, path in zip(stems, names, paths, strict=True):
        name = legal_name(stem if stems.count(stem) == 1 else name)
        while name in sources:
            name += "_"
        sources[name] = path
    return sources
