"""Match meshes: `python -m src.match source=a.ply target=b.obj`."""

from __future__ import annotations

import logging
import os
import time
from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig
from tqdm import tqdm

from meshspiral.data.shapes import DataError
from meshspiral.experiment.entry import entry_point
from meshspiral.experiment.runs import write_whole
from meshspiral.experiment.schema import ConfigError, typed

REFUSED = "refused.txt"
CONTENTS = {
    "map.txt": "for every vertex of the source one of the target, -1 for none",
    "remarks.txt": "what there was to say of the meshes",
    "template.txt": "for every vertex of the source one of the template",
    "match.npz target.npz": "the same, with confidences and places on the template",
    "source.ply target.ply": "in colours: equal ones correspond",
    "transferred.npy transferred.ply transferred.obj": "what was carried over to the source",
    "correspondence.png confidence.png": "both from the front and the back",
}

log = logging.getLogger(__name__)


@dataclass
class Match:
    source: str | None = None
    sources: str | None = None
    target: str | None = None
    run: str | None = None
    output: str | None = None
    repair: bool = False
    resample: bool | None = None
    smooth: bool = False
    transfer: str | None = None
    picture: bool | None = None
    accelerator: str = "cpu"
    workers: int | None = None


def check(config: DictConfig) -> DictConfig:
    found = typed(config, Match)
    for key in ("source", "sources", "target", "run", "output", "transfer"):
        if found[key] == "":
            raise ConfigError(f"{key}= is empty; leave it out, or give a path")
    if (found.source is None) == (found.sources is None):
        raise ConfigError("give source=, a mesh, or sources=, a pattern such as 'scans/*.ply'")
    if found.transfer and not found.target:
        raise ConfigError("transfer= carries something from a target to the source; give target=")
    if found.workers is not None and found.workers < 1:
        raise ConfigError(f"workers must be at least 1; got {found.workers}")
    return found


@entry_point("match", check)
def main(config: DictConfig) -> None:
    folder = (many if config.sources else pair)(config)
    log.info("Written to:  %s", folder)


def pair(config: DictConfig) -> Path:
    """Match one mesh. Returns the folder of what it wrote."""
    from meshspiral.matching import jobs as matches

    name = Path(config.source).stem
    if config.target:
        name += f"_to_{Path(config.target).stem}"
    folder = Path(config.output or Path("outputs", "matches", name))
    job = matches.Job.of(config, picture=config.picture is not False)
    began = time.perf_counter()
    with tqdm(
        total=2 if config.target else 1, desc="Matching", unit="mesh", leave=False, delay=1.0
    ) as progress:
        if config.target:
            job.target_labels()
            progress.update()
        found = matches.one(job, config.source, folder)
    if config.target:
        matches.write_target(job, folder)
    for line in matches.told(found):
        log.info(line)
    for names, what in CONTENTS.items():
        there = [name for name in names.split() if (folder / name).exists()]
        if there:
            log.info("  %-36s %s", " ".join(there), what)
    log.info("Seconds:     %.1f", time.perf_counter() - began)
    return folder


def many(config: DictConfig) -> Path:
    """Match every mesh of a pattern, each in a folder of its own; finished ones are left as they
    are. Errors: DataError if a mesh could not be used, or a process was killed."""
    from joblib import Parallel, cpu_count, delayed
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    from meshspiral.experiment.sweeps import legal_name
    from meshspiral.matching import jobs as matches

    folder = Path(config.output or Path("outputs", "matches", legal_name(config.sources)))
    meshes = named(config.sources, folder)
    job = matches.Job.of(config, picture=bool(config.picture))
    if config.target:
        job.carried()  # what is wrong is said before the work begins
        matches.write_target(job, folder)
    else:
        for old in matches.TARGET:
            (folder / old).unlink(missing_ok=True)
    waiting = [
        (path, folder / name)
        for name, path in meshes.items()
        if not matches.done(job, path, folder / name)
    ]
    if len(waiting) < len(meshes):
        log.info("%d of %d are done already", len(meshes) - len(waiting), len(meshes))
    workers = min(config.workers or cpu_count(), max(1, len(waiting)))
    refused: dict[str, str] = {}
    mended = 0
    began = time.perf_counter()
    # idle workers would stay for five minutes if this process were killed, with their memory
    pool = Parallel(
        n_jobs=workers,
        return_as="generator_unordered",
        pre_dispatch="2 * n_jobs",
        idle_worker_timeout=5,
    )
    work = pool(delayed(matches.attempt)(job, *each, workers) for each in waiting)
    try:
        for done in tqdm(work, total=len(waiting), desc="Matching", unit="mesh"):
            mended += done.mended
            if done.refused:
                refused[done.path] = done.refused
                tqdm.write(f"refused: {done.refused}")
    except TerminatedWorkerError as error:
        raise DataError(
            "a process was killed, probably for lack of memory: workers=1 needs less; "
            "the same command goes on"
        ) from error
    seconds = time.perf_counter() - began
    log.info(
        "%d meshes matched in %.1f s, %d of them mended (see remarks.txt), %d refused",
        len(waiting) - len(refused),
        seconds,
        mended,
        len(refused),
    )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / REFUSED).unlink(missing_ok=True)
    if refused:
        write_whole(folder / REFUSED, "".join(f"{refused[path]}\n" for path in sorted(refused)))
        raise DataError(
            f"{len(refused)} of {len(meshes)} meshes were refused; {folder / REFUSED} says why"
        )
    return folder


def named(pattern: str, output: Path) -> dict[str, str]:
    """The mesh files that a pattern finds, by names that differ; what lies in the folder to write
    to is left out. Errors: DataError for none."""
    import glob

    from meshspiral.geometry.mesh import SUFFIXES

    found = sorted(
        path
        for path in glob.glob(pattern, recursive=True)
        if path.lower().endswith(SUFFIXES)
        and os.path.isfile(path)
        and not Path(path).resolve().is_relative_to(output.resolve())
    )
    if not found:
        raise DataError(f"sources: {pattern!r} matches no mesh file ({', '.join(SUFFIXES)})")
    above = os.path.commonpath([os.path.dirname(os.path.abspath(path)) for path in found])
    names = [os.path.relpath(os.path.abspath(path), above).replace(os.sep, "_") for path in found]
    stems = [os.path.splitext(name)[0] for name in names]
    result: dict[str, str] = {}
    for stem, name, path in zip(stems, names, found, strict=True):
        name = stem if stems.count(stem) == 1 else name
        while name in result:
            name += "_"
        result[name] = path
    return result


if __name__ == "__main__":
    main()
