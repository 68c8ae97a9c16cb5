"""The match of one mesh file, in three steps: read, label, write."""

from __future__ import annotations

from pathlib import Path

from meshspiral.data.scans import open_scan
from meshspiral.matching.job import FileMatch, MatchJob
from meshspiral.matching.writing import write_match


def match_file(job: MatchJob, path: str, folder: Path) -> FileMatch:
    """Read a source, label it, and write its match.

    Args:
        job: What all sources of the command share.
        path: The source's file.
        folder: Where the match is written.

    Raises:
        MeshError: The mesh cannot be used.
        DataError: An input would be overwritten, or the folder has the match of another mesh.
        OSError: A file cannot be written.
    """
    scan = open_scan(path, job.config.repair)
    match = job.label(path, scan)
    write_match(job, match, folder)
    return match
