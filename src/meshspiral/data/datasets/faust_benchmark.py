"""Trained on FAUST's connectivity, tested on others: N. Sharp's remeshed FAUST."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path

from meshspiral.data.datasets.faust import Faust
from meshspiral.data.datasets.folder import find_meshes
from meshspiral.data.shapes import DataError, Shape, ShapeSet, read_labels
from meshspiral.geometry.mesh import Mesh, read_mesh

log = logging.getLogger(__name__)

POLICIES = ("iso", "qes", "mc", "dense")
_HELP = (
    "The benchmark (remeshed test shapes of FAUST) is public: git clone "
    "https://github.com/nmwsharp/discretization-robust-correspondence-benchmark and pass "
    "data.benchmark_root=/path/to/discretization-robust-correspondence-benchmark."
)


class FaustBenchmark(ShapeSet):
    """FAUST's registrations to train and validate on, the benchmark's meshes to test on.

    root: as for `Faust`. benchmark_root: the benchmark's repository or its data folder.
    policy: how the test meshes were made: "iso", "qes", "mc" or "dense". Their labels are the
    nearest vertices of the template, read from the `.txt` beside each mesh.
    train: None for the registrations of subjects 0-6, or meshes of the benchmark's layout as in
    `find_meshes`, relative to its data folder. As published it shows subjects 8 and 9 alone: train
    on 080-089, say, and what is left to test are 090-099. A subject that is trained on is neither
    validated nor tested on, and the log says so.
    Errors: DataError, also if nothing is left to test; MeshError for a mesh that cannot be used.
    """

    def __init__(
        self,
        root: str | Path | None,
        benchmark_root: str | Path | None,
        policy: str = "iso",
        train: str | Sequence[str] | None = None,
    ) -> None:
        if policy not in POLICIES:
            raise DataError(f"policy must be one of {', '.join(POLICIES)}; got {policy!r}")
        self._faust = Faust(root)
        data = _data_folder(benchmark_root, policy)
        names = [f"tr_reg_{policy}_{i:03d}" for i in range(80, 100)]
        self._files = {name: data / policy / f"{name}.ply" for name in names}
        self.names = self._faust.names | {"test": names}
        if train is not None:
            meshes = find_meshes(data, train)
            self.names["train"] = [mesh.stem for mesh in meshes]
            for name, mesh in zip(self.names["train"], meshes, strict=True):
                if self._files.setdefault(name, mesh) != mesh:
                    raise DataError(f"train: {self._files[name]} and {mesh} have the same name")
            self._leave_out({_number(mesh.stem, mesh) // 10 for mesh in meshes})
        files = [f for mesh in self._files.values() for f in (mesh, mesh.with_suffix(".txt"))]
        missing = [file for file in files if not file.is_file()]
        if missing:
            raise DataError(f"{len(missing)} files are missing, the first {missing[0]}. {_HELP}")

    def _leave_out(self, subjects: set[int]) -> None:
        """Take subjects that are trained on out of validation and test."""
        for split in ("val", "test"):
            names = self.names[split]
            left = [name for name in names if _number(name, name) // 10 not in subjects]
            if not left:
                raise DataError(f"train: shows all subjects there are for {split}; leave one out")
            if len(left) < len(names):
                log.warning(
                    "%d of %d shapes for %s show a subject that is trained on; left out",
                    len(names) - len(left),
                    len(names),
                    split,
                )
            self.names[split] = left

    @property
    def template(self) -> Mesh:
        return self._faust.template

    def load(self, name: str) -> Shape:
        if name not in self._files:
            return self._faust.load(name)
        mesh = read_mesh(self._files[name])
        labels = read_labels(self._files[name].with_suffix(".txt"), len(mesh.vertices))
        return Shape(mesh, labels, len(self.template.vertices))


def _data_folder(benchmark_root: str | Path | None, policy: str) -> Path:
    if not benchmark_root:
        raise DataError(f"data.benchmark_root is not set. {_HELP}")
    root = Path(benchmark_root).expanduser()
    for data in (root / "data", root):
        if (data / policy).is_dir():
            return data
    raise DataError(f"{root} holds neither data/{policy} nor {policy}. {_HELP}")


def _number(stem: str, shown: str | Path) -> int:
    match = re.fullmatch(r"tr_reg_(?:[a-z]+_)?(\d{3})", stem)
    if match is None:
        raise DataError(f"train: {shown} is not called tr_reg_<policy>_<number>")
    return int(match[1])
