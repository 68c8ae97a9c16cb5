"""FAUST's 100 registrations (Bogo et al. 2014), read from the folder or from the zip archive."""

from __future__ import annotations

import re
import zipfile
from collections import defaultdict
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path, PurePosixPath

from pydantic import Field

from meshspiral.data.mesh_files import parse_mesh, read_mesh
from meshspiral.data.settings import DataSettings, Text
from meshspiral.data.shapes import (
    DataError,
    Shape,
    ShapeSet,
    file_stamp,
    registered_shape,
    subject_split,
)
from meshspiral.geometry.mesh import Mesh

NAMES = [f"tr_reg_{i:03d}" for i in range(100)]
_REGISTRATION = re.compile(r"((?:[^/]+/)?training/registrations/)(tr_reg_\d{3})\.ply")
_HELP = (
    "FAUST is available after registration at https://faust-leaderboard.is.tuebingen.mpg.de "
    "(see also http://faust.is.tue.mpg.de); then set data.root=/path/to/MPI-FAUST or "
    "data.root=/path/to/MPI-FAUST.zip. Without registration, use data=bodies_6890: 100 meshes of "
    "6890 vertices, also of 10 people in 10 poses."
)


class Faust(ShapeSet, name="faust"):
    """The registrations tr_reg_000 .. tr_reg_099 of MPI-FAUST: 6890 vertices, one connectivity.

    Shape i shows subject i // 10 in pose i % 10. The template is tr_reg_000. Vertex i has label i.

    Args:
        root: The extracted MPI-FAUST folder, a folder that contains it, or MPI-FAUST.zip, which is
            read without extracting it.

    Raises:
        DataError: The data are missing, incomplete or damaged. When a shape is loaded: it does not
            have the template's number of vertices.
        MeshError: When a shape is loaded: its mesh is unusable.
    """

    class Settings(DataSettings):
        root: Text | None = Field(
            description="the extracted MPI-FAUST, a folder that contains it, or MPI-FAUST.zip"
        )

    def __init__(self, root: str | Path | None) -> None:
        if not root:
            raise _unusable("data.root is not set")
        self._root = Path(root).expanduser()
        self._files = _registrations(self._root)
        missing = [name for name in NAMES if name not in self._files]
        if missing:
            raise _unusable(
                f"{self._root} lacks {len(missing)} of the {len(NAMES)} registrations, the first "
                f"training/registrations/{missing[0]}.ply"
            )
        self.names = subject_split(NAMES)

    @cached_property
    def template(self) -> Mesh:
        return self._read(NAMES[0])

    def load(self, name: str) -> Shape:
        if name not in NAMES:
            raise DataError(f"name must be one of {NAMES[0]} .. {NAMES[-1]}, got {name!r}")
        return registered_shape(self._read(name), self.template)

    def stamp(self, name: str) -> str:
        root = self._root
        return file_stamp(root / self._files[name] if root.is_dir() else root)

    def _read(self, name: str) -> Mesh:
        file = self._files[name]
        if self._root.is_dir():
            return read_mesh(self._root / file)
        try:
            with zipfile.ZipFile(self._root) as archive:
                data = archive.read(file)
        except Exception as error:  # a damaged archive raises zlib, lzma, CRC errors, ...
            raise _unusable(f"{self._root}: cannot extract {file} ({error})") from error
        return parse_mesh(data, ".ply", f"{self._root}:{file}")


def _registrations(root: Path) -> dict[str, str]:
    """The path of each registration inside `root`, a folder or a zip archive, by name."""
    if root.is_dir():
        patterns = ("training/registrations/*.ply", "*/training/registrations/*.ply")
        paths = [path for pattern in patterns for path in root.glob(pattern)]
        return _most_complete(path.relative_to(root).as_posix() for path in paths)
    try:
        with zipfile.ZipFile(root) as archive:
            names = archive.namelist()
    except FileNotFoundError as error:
        raise _unusable(f"{root} does not exist") from error
    except zipfile.BadZipFile as error:
        raise _unusable(f"{root} is neither a folder nor an intact zip ({error})") from error
    except OSError as error:
        raise _unusable(f"{root} cannot be read ({error.strerror or error})") from error
    for name in names:  # nothing is extracted, but such an archive is not FAUST
        if name.startswith("/") or ".." in PurePosixPath(name.replace("\\", "/")).parts:
            raise _unusable(f"{root} contains the path {name!r}, which points outside the archive")
    return _most_complete(names)


def _most_complete(paths: Iterable[str]) -> dict[str, str]:
    """The registrations of the most complete folder; copies in several folders are never mixed.

    Of equally complete folders, the first by name is taken.
    """
    folders: dict[str, dict[str, str]] = defaultdict(dict)
    for path in sorted(paths):
        if match := _REGISTRATION.fullmatch(path):
            folders[match[1]][match[2]] = path
    return max(folders.values(), key=lambda files: len(files.keys() & set(NAMES)), default={})


def _unusable(reason: str) -> DataError:
    return DataError(f"FAUST (100 registered scans of people, Bogo et al. 2014): {reason}. {_HELP}")
