"""FAUST for training and its remeshed test shapes by N. Sharp for testing."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

from pydantic import Field

from meshspiral.data.datasets.faust import Faust
from meshspiral.data.datasets.folder import find_meshes
from meshspiral.data.mesh_files import read_mesh
from meshspiral.data.settings import DataSettings, Text
from meshspiral.data.shapes import DataError, Shape, ShapeSet, file_stamp, read_labels
from meshspiral.geometry.mesh import Mesh

log = logging.getLogger(__name__)

Policy = Literal["iso", "qes", "mc", "dense"]
_HELP = (
    "The benchmark (remeshed test shapes of FAUST) is public: git clone "
    "https://github.com/nmwsharp/discretization-robust-correspondence-benchmark and set "
    "data.benchmark_root=/path/to/discretization-robust-correspondence-benchmark."
)


class FaustBenchmark(ShapeSet, name="faust_benchmark"):
    """FAUST's registrations for training and validation, the benchmark's meshes for testing.

    The labels of a test mesh are the nearest vertices of the template, read from the `.txt` file
    beside the mesh. A subject that is trained on is left out of validation and test, with a
    warning.

    Args:
        root: As for `Faust`.
        benchmark_root: The benchmark's repository or its data folder.
        policy: How the test meshes were remeshed: "iso", "qes", "mc" or "dense".
        train: Training meshes in the benchmark's layout, as entries of `find_meshes` relative to
            its data folder; None for FAUST's registrations of subjects 0-6. The published benchmark
            contains only subjects 8 and 9: training on meshes 080-089, for example, leaves 090-099
            for testing.

    Raises:
        DataError: Data are missing or invalid, or no shape is left for validation or test.
        MeshError: When a shape is loaded: its mesh is unusable.
    """

    class Settings(DataSettings):
        root: Text | None = Field(
            description="the extracted MPI-FAUST, a folder that contains it, or MPI-FAUST.zip"
        )
        benchmark_root: Text | None = Field(
            description="the benchmark's repository or its data folder"
        )
        policy: Policy = Field(description="how the test meshes were remeshed")
        train: list[Text] | None = Field(
            description="meshes of the benchmark to train on, names or patterns; null: FAUST's "
            "registrations of subjects 0 to 6"
        )

    def __init__(
        self,
        root: str | Path | None,
        benchmark_root: str | Path | None,
        policy: str = "iso",
        train: str | Sequence[str] | None = None,
    ) -> None:
        if policy not in get_args(Policy):
            raise DataError(f"policy must be one of {', '.join(get_args(Policy))}, got {policy!r}")
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
            self._exclude({_number(mesh.stem, mesh) // 10 for mesh in meshes})
        files = [f for mesh in self._files.values() for f in (mesh, mesh.with_suffix(".txt"))]
        missing = [file for file in files if not file.is_file()]
        if missing:
            raise DataError(f"{len(missing)} files are missing; the first is {missing[0]}. {_HELP}")

    def _exclude(self, subjects: set[int]) -> None:
        """Remove shapes of these subjects from validation and test."""
        for split in ("val", "test"):
            names = self.names[split]
            left = [name for name in names if _number(name, name) // 10 not in subjects]
            if not left:
                raise DataError(f"train contains every subject of {split}; leave one of them out")
            if len(left) < len(names):
                log.warning(
                    "%d of %d %s shapes show a training subject and are left out",
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

    def stamp(self, name: str) -> str:
        if name not in self._files:
            return self._faust.stamp(name)
        return file_stamp(self._files[name], self._files[name].with_suffix(".txt"))


def _data_folder(benchmark_root: str | Path | None, policy: str) -> Path:
    if not benchmark_root:
        raise DataError(f"data.benchmark_root is not set. {_HELP}")
    root = Path(benchmark_root).expanduser()
    for data in (root / "data", root):
        if (data / policy).is_dir():
            return data
    raise DataError(f"{root} contains neither data/{policy} nor {policy}. {_HELP}")


def _number(stem: str, source: str | Path) -> int:
    """The number in a name such as tr_reg_iso_085; `source` is what an error message names."""
    match = re.fullmatch(r"tr_reg_(?:[a-z]+_)?(\d{3})", stem)
    if match is None:
        raise DataError(f"train: the name of {source} must be tr_reg_<policy>_<number>")
    return int(match[1])
