"""Match meshes: `python -m src.match source=a.ply target=b.obj`."""

from __future__ import annotations

import contextlib
import logging
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from meshspiral.data.files import legal_name, write_file
from meshspiral.data.mesh_files import SUFFIXES
from meshspiral.data.progress import Progress
from meshspiral.data.shapes import DataError
from meshspiral.experiment.entry import entry_point
from meshspiral.experiment.quoting import quote
from meshspiral.experiment.schema import MatchConfig

REFUSED = "refused.txt"
CONTENTS = {
    "map.txt": "line i: the target vertex of source vertex i, -1 for none",
    "template.txt": "line i: the template vertex of source vertex i, -1 for none",
    "match.npz target.npz": "the same, with points on the template and confidences",
    "remarks.txt": "confidences and defects of the meshes",
    "source.ply target.ply": "the meshes; corresponding points have equal colours",
    "transferred.npy transferred.ply transferred.obj": "the target's values, on the source",
    "correspondence.png confidence.png": "renders from the front and the back",
    "dense.npz dense.csv": "for each source vertex a point in a face of the target",
    "registered.ply": "the source with the vertices and faces of the template",
    "morph.glb": "the source, turning into the target and back",
    "view.html": "both meshes to turn and compare; open it in a browser",
}

log = logging.getLogger(__name__)


def name_files(words: list[str]) -> list[str]:
    """`match a.ply b.ply` as `match source=a.ply target=b.ply`.

    Args:
        words: The words of a command line. One with the suffix of a mesh file is a file, unless it
            has an = and no file has its name. A role that a word names is taken.
    """
    taken = {word.partition("=")[0] for word in words}
    roles = iter([role for role in ("source", "target") if role not in taken])
    named = []
    for word in words:
        is_file = word.lower().endswith(SUFFIXES) and ("=" not in word or os.path.isfile(word))
        role = next(roles, None) if is_file else None
        named.append(f"{role}={quote(word)}" if role else word)
    return named


@entry_point("match", MatchConfig, rewrite=name_files)
def main(config: MatchConfig) -> None:
    folder = match_many(config) if config.sources else match_one(config)
    log.info("Written to:  %s", folder)


def match_one(config: MatchConfig) -> Path:
    """Match one mesh; returns the folder of the results."""
    from meshspiral.matching.job import MatchJob
    from meshspiral.matching.pair import match_file
    from meshspiral.matching.writing import remark_lines, write_target

    if Path(config.source).is_dir():
        raise DataError(
            f"source={config.source} is a folder; to match all meshes in it: "
            f"sources={config.source}"
        )
    name = Path(config.source).stem
    if config.target:
        name += f"_to_{Path(config.target).stem}"
    folder = Path(config.output or Path("outputs", "matches", legal_name(name)))
    job = MatchJob(config, render=config.picture is not False)
    began = time.perf_counter()
    with stage_bar("target", "source") if config.target else stage_bar("source") as report:
        match = match_file(job, config.source, folder, report)
    if config.target:
        write_target(job, folder)
    for line in remark_lines(match):
        log.info(line)
    for names, content in CONTENTS.items():
        written = [name for name in names.split() if (folder / name).exists()]
        if written:
            log.info("  %-36s %s", " ".join(written), content)
    log.info("Seconds:     %.1f", time.perf_counter() - began)
    return folder


@contextlib.contextmanager
def stage_bar(*roles: str) -> Iterator[Callable[[str, str], None]]:
    """A progress bar over the stages of a match; yields the function to report them to.

    Args:
        *roles: "source" and "target", in the order in which they are labelled.
    """
    from meshspiral.matching.job import STAGES

    reading, *labelling = STAGES
    stages = [(role, reading) for role in reversed(roles)]  # a source's errors come before any work
    stages += [(role, stage) for role in roles for stage in labelling]
    stages += [("source", "writing")] * ("source" in roles)
    bar_format = "{desc:<24} {n_fmt:>2}/{total_fmt}|{bar}| {elapsed}"
    with Progress(total=len(stages), bar_format=bar_format, leave=False, dynamic_ncols=True) as bar:

        def report(role: str, stage: str) -> None:
            bar.n = stages.index((role, stage))
            bar.set_description_str(f"{role}: {stage}")

        yield report


def match_many(config: MatchConfig) -> Path:
    """Match all meshes of a pattern; returns the folder of the results.

    Raises:
        DataError: A mesh was refused, or a worker process was killed.
    """
    from meshspiral.matching.batch import find_sources, match_batch
    from meshspiral.matching.index import INDEX, write_index
    from meshspiral.matching.job import MatchJob
    from meshspiral.matching.writing import (
        TARGET_FILES,
        delete_files,
        delete_match,
        write_script,
        write_target,
    )

    folder = Path(config.output or Path("outputs", "matches", legal_name(config.sources)))
    sources = find_sources(config.sources, folder)
    job = MatchJob(config, render=bool(config.picture))
    if config.target:
        with stage_bar("target") as report:
            job.prepare(report)  # reports mistakes before the work begins
        write_target(job, folder)
    else:
        delete_files(folder, TARGET_FILES)
    if job.with_page:
        write_script(folder)  # before the pages, which a stopped command leaves
    began = time.perf_counter()
    result = match_batch(job, sources, folder, config.workers)
    log.info(
        "%d meshes matched in %.1f s (%d repaired, see remarks.txt), %d refused",
        result.matched,
        time.perf_counter() - began,
        result.repaired,
        len(result.refused),
    )
    refused = [name for name, path in sources.items() if path in result.refused]
    for name in refused:
        delete_match(folder / name, sources[name])  # of an earlier content of the file
    write_index(folder, sources.keys() - refused, result.refused.values())
    log.info("All of them: %s", folder / INDEX)
    delete_files(folder, (REFUSED,))
    if result.refused:
        reasons = [result.refused[path] for path in sorted(result.refused)]
        folder.mkdir(parents=True, exist_ok=True)
        write_file(folder / REFUSED, "\n".join(reasons) + "\n")
        raise DataError(
            f"{len(reasons)} of {len(sources)} meshes were refused; {folder / REFUSED} says why"
        )
    return folder


if __name__ == "__main__":
    main()
