"""Memory and waiting as the data set grows, measured outside the test suite:

    python -m tests.growth 200,1000 1500 model=fcs

Trains for one epoch on that many meshes of 1500 or 6890 vertices, bodies stretched at random. The
first start of each fills the cache; of a second one, prints the seconds until the first step, the
largest memory of the process beyond the imports, and the share of the training time spent waiting.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from pydantic import Field

from meshspiral.data.datasets.bodies import Bodies
from meshspiral.data.shapes import Shape, registered_shape
from meshspiral.geometry.mesh import Mesh


class Many(Bodies, name="many"):
    """Any number of bodies, each stretched along three axes by factors of its own."""

    class Settings(Bodies.Settings):
        meshes: int = Field(description="number of training meshes")

    def __init__(self, vertices: int, meshes: int):
        super().__init__(vertices)
        self._originals = self.names["train"]
        self.names = {**self.names, "train": [f"many_{i}" for i in range(meshes)]}
        self.names["val"] = self.names["val"][:2]
        self.names["test"] = self.names["test"][:2]

    def load(self, name: str) -> Shape:
        if not name.startswith("many_"):
            return super().load(name)
        number = int(name.removeprefix("many_"))
        mesh = super().load(self._originals[number % len(self._originals)]).mesh
        factors = np.random.default_rng(number).uniform(0.9, 1.1, 3)
        return registered_shape(Mesh(mesh.vertices * factors, mesh.faces, name), self.template)

    def stamp(self, name: str) -> str:
        return f"{name} {super().stamp(name)}"


def megabytes() -> float:
    """The largest memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def measure(folder: str, words: list[str]) -> None:
    """Train in this process, and print what was measured as JSON."""
    from meshspiral.training import callbacks, run
    from tests.helpers import composed

    config = composed(words)
    before, began, first = megabytes(), time.perf_counter(), []
    start = callbacks.Speed.on_train_batch_start

    def note(self, *arguments) -> None:
        first.append(time.perf_counter())
        start(self, *arguments)

    callbacks.Speed.on_train_batch_start = note
    Path(folder).mkdir()
    metrics = run.train(config, Path(folder))
    wait = metrics["seconds/wait"] / metrics["seconds/train"]
    values = {"start": first[0] - began, "memory": megabytes() - before, "wait": wait}
    print("\n" + json.dumps(values))


def main() -> None:
    if sys.argv[1] == "measure":
        return measure(sys.argv[2], sys.argv[3:])
    counts, vertices, words = sys.argv[1].split(","), sys.argv[2], sys.argv[3:]
    print("| meshes | first step after | memory | waiting |\n| --- | --- | --- | --- |")
    for count in counts:
        data = ["data=bodies", "data.name=many", f"data.vertices={vertices}"]
        data += [f"+data.meshes={count}", "data.cache_dir=outputs/growth"]
        quick = ["optim.epochs=1", "picture=false", *words]
        for _ in range(2):
            with tempfile.TemporaryDirectory() as folder:
                command = [sys.executable, "-m", "tests.growth", "measure", f"{folder}/run"]
                done = subprocess.run(
                    [*command, *data, *quick], stdout=subprocess.PIPE, text=True, check=True
                )
        found = json.loads(done.stdout.strip().splitlines()[-1])
        row = f"{found['start']:.1f} s | {found['memory']:.0f} MB | {100 * found['wait']:.1f} %"
        print(f"| {count} | {row} |", flush=True)


if __name__ == "__main__":
    main()
