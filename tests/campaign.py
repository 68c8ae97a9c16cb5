"""Ten thousand damaged meshes through the whole chain, outside the tests:

    python -m tests.campaign 10000

Every outcome must be labels or one line. Prints how many of which, what the slowest took, and every
outcome that is neither, with the number that makes it again.
"""

from __future__ import annotations

import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import torch
from joblib import Parallel, delayed
from tqdm import tqdm

from meshspiral.data.datasets.bodies import Bodies
from meshspiral.data.scans import open_scan
from meshspiral.geometry.mesh import MeshError
from meshspiral.geometry.resample import resample
from meshspiral.matching.matcher import Matcher
from tests.damage import damaged_file

KINDS = {"plain": (False, False), "resampled": (True, False), "smooth": (False, True)}
BLOCK = 50


def block(first: int, last: int) -> list[tuple[int, str, float, str]]:
    """For each number its outcome, the seconds it took, and what is wrong with it."""
    torch.set_num_threads(1)
    np.seterr(all="ignore")
    warnings.simplefilter("ignore")
    body = resample(Bodies().template, 400).mesh
    matchers = {kind: Matcher.load(resampled=r, smooth=s) for kind, (r, s) in KINDS.items()}
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(first, last):
            suffix, data = damaged_file(body, number)
            path = Path(folder, f"mesh{suffix}")
            path.write_bytes(data)
            kind = list(KINDS)[number % 3]
            began = time.perf_counter()
            outcome, wrong = one(path, matchers[kind], repair=number % 2 == 0)
            rows.append((number, outcome, time.perf_counter() - began, wrong))
    return rows


def one(path: Path, matcher: Matcher, repair: bool) -> tuple[str, str]:
    try:
        found = open_scan(path, repair)
        labels = matcher.label(found)
    except MeshError as error:
        line = str(error)
        return "refused in one line", "" if "\n" not in line and len(line) < 600 else line
    except Exception:
        return "error", traceback.format_exc()
    known = found.place >= 0
    whole = np.array_equal(labels.template >= 0, known) and np.isfinite(labels.points[known]).all()
    return "labelled", "" if whole else "labels that are not whole"


def main() -> None:
    count = int(sys.argv[1])
    blocks = [(first, min(first + BLOCK, count)) for first in range(0, count, BLOCK)]
    outcomes: Counter[str] = Counter()
    slowest = (0.0, -1)
    began = time.perf_counter()
    pool = Parallel(n_jobs=-1, return_as="generator_unordered")
    for rows in tqdm(pool(delayed(block)(*each) for each in blocks), total=len(blocks)):
        for number, outcome, seconds, wrong in rows:
            outcomes["wrong" if wrong else outcome] += 1
            slowest = max(slowest, (seconds, number))
            if wrong:
                tqdm.write(f"{number}: {wrong}")
    for outcome, times in outcomes.most_common():
        print(f"{times:8,} {outcome}")
    print(f"slowest: {slowest[0]:.1f} s (number {slowest[1]})")
    print(f"{count:,} meshes in {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
