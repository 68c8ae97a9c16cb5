"""How well a truncated basis gives ACNN's kernels, measured outside the test suite:

    python -m tests.kernels

For numbers of eigenfunctions, prints seconds for one body, and the share of the kernels' entries
that are those of all eigenfunctions.
"""

from __future__ import annotations

import time

import numpy as np

from meshspiral.data.datasets.bodies import Bodies
from meshspiral.experiment.compose import compose_train
from meshspiral.neighbourhoods import Neighbourhood

COUNTS = ("null", 100, 300, 600)


def main() -> None:
    mesh, exact = Bodies(1500).load("s0_a_pose").mesh, None
    print("eigenfunctions, seconds, share of the entries")
    for count in COUNTS:
        words = ["model=acnn", f"neighbourhood.eigenfunctions={count}"]
        neighbourhood = Neighbourhood.of(compose_train(words).neighbourhood)
        began = time.perf_counter()
        found = neighbourhood.compute(mesh)["indices"]
        seconds = time.perf_counter() - began
        exact = found if exact is None else exact
        shared = (found[..., :, None] == exact[..., None, :]).any(-1)
        print(f"{count}, {seconds:.1f}, {np.mean(shared):.3f}")


if __name__ == "__main__":
    main()
