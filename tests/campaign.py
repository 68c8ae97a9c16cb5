"""A fuzz test of matching with many damaged meshes, too long for the test suite:

    python -m tests.campaign 10000

Every mesh must get labels or be refused in one line. Prints the number of each outcome, the slowest
mesh, and every violation with the mesh's number, which reproduces it.
"""

from __future__ import annotations

import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from joblib import Parallel, delayed
from tqdm import tqdm

from meshspiral import Matcher, open_scan
from meshspiral.data.datasets.bodies import Bodies
from meshspiral.geometry.mesh import MeshError
from meshspiral.geometry.resample import resample
from tests.damage import damaged_file

OPTIONS = [
    {"resampled": False},
    {"resampled": True},
    {"resampled": False, "smooth": True},
]
BLOCK = 50  # meshes per job


class Outcome(NamedTuple):
    """What happened to a mesh; `violation` describes what is wrong with that, or is empty."""

    kind: str
    violation: str


def check_block(first: int, last: int) -> list[tuple[int, float, Outcome]]:
    """Label the meshes first..last-1; returns the number, seconds and outcome of each."""
    torch.set_num_threads(1)
    np.seterr(all="ignore")
    warnings.simplefilter("ignore")
    body = resample(Bodies().template, 400).mesh
    matchers = [Matcher.load(**options) for options in OPTIONS]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(first, last):
            suffix, data = damaged_file(body, number)
            path = Path(folder, f"mesh{suffix}")
            path.write_bytes(data)
            began = time.perf_counter()
            outcome = check_file(path, matchers[number % 3], repair=number % 2 == 0)
            rows.append((number, time.perf_counter() - began, outcome))
    return rows


def check_file(path: Path, matcher: Matcher, repair: bool) -> Outcome:
    """Label one mesh file."""
    try:
        found = open_scan(path, repair)
        labels = matcher.label(found)
    except MeshError as error:
        message = str(error)
        one_line = "\n" not in message and len(message) < 600
        return Outcome("refused in one line", "" if one_line else message)
    except Exception:
        return Outcome("error", traceback.format_exc())
    known = found.vertex_of >= 0
    complete = np.array_equal(labels.template >= 0, known)
    complete = complete and np.isfinite(labels.points[known]).all()
    return Outcome("labelled", "" if complete else "labels are missing")


def main() -> None:
    count = int(sys.argv[1])
    blocks = [(first, min(first + BLOCK, count)) for first in range(0, count, BLOCK)]
    outcomes: Counter[str] = Counter()
    slowest = (0.0, -1)
    began = time.perf_counter()
    pool = Parallel(n_jobs=-1, return_as="generator_unordered")
    for rows in tqdm(pool(delayed(check_block)(*each) for each in blocks), total=len(blocks)):
        for number, seconds, outcome in rows:
            outcomes["violation" if outcome.violation else outcome.kind] += 1
            slowest = max(slowest, (seconds, number))
            if outcome.violation:
                tqdm.write(f"{number}: {outcome.violation}")
    for kind, meshes in outcomes.most_common():
        print(f"{meshes:8,} {kind}")
    print(f"slowest: {slowest[0]:.1f} s (number {slowest[1]})")
    print(f"{count:,} meshes in {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
