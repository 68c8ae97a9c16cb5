"""The match of one mesh file, in three steps: read, label, write."""

from __future__ import annotations

from pathlib import Path

from meshspiral.matching.job import FileMatch, FileReport, MatchJob
from meshspiral.matching.writing import write_match


def match_file(
    job: MatchJob, path: str, folder: Path, report: FileReport | None = None
) -> FileMatch:
    """Read a source, label it, and write its match.

    The target is labelled before, unless the job has it from an earlier source.

    Args:
        job: What all sources of the command share.
        path: The source's file.
        folder: Where the match is written.
        report: Called with "source" or "target" and each stage when it begins: one of `STAGES` of
            `meshspiral.matching.job`, or "writing".

    Raises:
        MeshError: The mesh cannot be used.
        DataError: An input would be overwritten, or the folder has the match of another mesh.
        OSError: A file cannot be written.
    """
    scan = job.read(path, report)  # its errors come before any work
    job.prepare(report)
    match = job.label(path, scan, report)
    if report:
        report("source", "writing")
    write_match(job, match, folder)
    return match
