"""Meshes in a folder of your own, with a template, label files and a split."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path, PurePath
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from meshspiral.data.mesh_files import SUFFIXES, read_mesh
from meshspiral.data.settings import DataSettings, Text
from meshspiral.data.shapes import (
    SPLITS,
    DataError,
    Shape,
    ShapeSet,
    file_stamp,
    read_labels,
    registered_shape,
)
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.repair import outwards


def _files(value: Any) -> Any:
    many = isinstance(value, list) and all(isinstance(name, str) for name in value)
    if not (value is None or isinstance(value, str) or many):
        raise ValueError("must be file names or patterns")
    return value


Files = Annotated[Any, BeforeValidator(_files)]


class Folder(ShapeSet, name="folder"):
    """Meshes in a folder, each with a file of labels: the template vertices of its vertices.

    The name of a shape is its path relative to `root`, without suffix and with "_" for "/", and for
    "@" and "~", which mark versions of a shape.

    Args:
        root: The folder.
        template: A mesh file in the folder.
        train: Training meshes, as entries of `find_meshes`.
        val: Validation meshes, likewise.
        test: Test meshes, likewise.
        labels: Label file of a mesh (see `read_labels`), relative to the folder of the mesh;
            "{stem}" stands for the mesh's file name without suffix. "identity" or None if every
            mesh has the template's vertices in the template's order.

    Raises:
        DataError: A file is missing or outside `root`, two meshes would have the same name, or a
            mesh is in two splits.
    """

    class Settings(DataSettings):
        root: Text | None = Field(description="folder to which all other paths are relative")
        template: Text | None = Field(description="mesh file whose vertices are the labels")
        train: Files = Field(description="training meshes: names and patterns, or a .txt of them")
        val: Files = Field(description="validation meshes, likewise")
        test: Files = Field(description="test meshes, likewise")
        labels: Text | None = Field(
            description="label file of a mesh, relative to the mesh's folder, {stem} is its name "
            "without suffix; identity: label i for vertex i"
        )

    def __init__(
        self,
        root: str | Path | None,
        template: str | None,
        train: str | Sequence[str] | None,
        val: str | Sequence[str] | None,
        test: str | Sequence[str] | None,
        labels: str | None = "{stem}.txt",
    ) -> None:
        if not root or not template:
            raise DataError(
                "a folder of meshes needs data.root=/path/to/folder and data.template=a mesh "
                f"file in it, got data.root={root!r} and data.template={template!r}"
            )
        root = Path(root).expanduser()
        if not root.is_dir():
            raise DataError(f"data.root must be a folder, got {root}")
        templates = find_meshes(root, [template])
        if len(templates) != 1:
            raise DataError(
                f"data.template must match one mesh; {template!r} matches {len(templates)} meshes"
            )
        self._template = templates[0]
        self._meshes: dict[str, Path] = {}
        self._labels: dict[str, Path | None] = {}
        self.names = {split: [] for split in SPLITS}
        owner: dict[Path, str] = {}
        for split, entries in zip(SPLITS, (train, val, test), strict=True):
            for mesh in find_meshes(root, entries):
                other = owner.setdefault(mesh.resolve(), split)
                if other != split:
                    raise DataError(
                        f"{mesh} is in {other} and in {split}; a mesh must be in one split only"
                    )
                name = "_".join(mesh.relative_to(root).with_suffix("").parts)
                name = name.replace("@", "_").replace("~", "_")
                if name in self._meshes:
                    raise DataError(f"{self._meshes[name]} and {mesh} would both be named {name}")
                self._meshes[name] = mesh
                self._labels[name] = _label_file(root, mesh, labels)
                self.names[split].append(name)
        if not self._meshes:
            raise DataError(f"{root}: train, val and test are all empty")

    @cached_property
    def template(self) -> Mesh:
        return outwards(read_mesh(self._template))[0]

    def load(self, name: str) -> Shape:
        if name not in self._meshes:
            raise DataError(f"no mesh is named {name!r}; the first is {next(iter(self._meshes))}")
        mesh, _ = outwards(read_mesh(self._meshes[name]))  # as `match` reads it
        labels = self._labels[name]
        if labels is None:
            return registered_shape(mesh, self.template)
        read = read_labels(labels, len(mesh.vertices))
        return Shape(mesh, read, len(self.template.vertices))

    def stamp(self, name: str) -> str:
        return file_stamp(self._meshes[name], self._labels[name])


def find_meshes(root: Path, entries: str | Sequence[str] | None) -> list[Path]:
    """The mesh files that `entries` name, in the order of the entries and without duplicates.

    Args:
        root: The folder that contains all meshes.
        entries: File names or glob patterns relative to `root`; or the path of a `.txt` file
            (absolute, or relative to `root`) with one of these per line; None for no meshes. The
            matches of a pattern are sorted; hidden files and files that are not meshes are skipped.

    Raises:
        DataError: An entry matches no mesh or points outside `root`: by an absolute path, "..", or
            a symbolic link.
    """
    if isinstance(entries, str):
        entries = _lines(root / entries) if entries.endswith(".txt") else [entries]
    found: dict[Path, Path] = {}
    for entry in map(str, entries or ()):
        if PurePath(entry).is_absolute() or ".." in PurePath(entry).parts:
            raise DataError(f"{entry!r} must be relative to {root}, without '..'")
        for mesh in _matches(root, entry):
            found.setdefault(_inside(root, mesh), mesh)
    return list(found.values())


def _matches(root: Path, entry: str) -> list[Path]:
    if (root / entry).is_file():  # before glob: a file name may contain brackets
        matches = [root / entry]
    else:
        try:
            matches = sorted(path for path in root.glob(entry) if not path.name.startswith("."))
        except (ValueError, IndexError, NotImplementedError) as error:
            raise DataError(f"{entry!r} is neither a file nor a valid glob pattern") from error
    meshes = [path for path in matches if path.suffix.lower() in SUFFIXES and path.is_file()]
    if not meshes:
        raise DataError(f"{root}: {entry!r} matches no mesh file ({', '.join(SUFFIXES)})")
    return meshes


def _inside(root: Path, path: Path) -> Path:
    """The resolved path of a file, which must be inside `root`."""
    real = path.resolve()
    if not real.is_relative_to(root.resolve()):
        raise DataError(f"{path} must be inside {root}, but is a path to {real}")
    return real


def _label_file(root: Path, mesh: Path, labels: str | None) -> Path | None:
    if labels is None or labels == "identity":
        return None
    path = mesh.parent / labels.replace("{stem}", mesh.stem)
    if not path.is_file():
        raise DataError(
            f"{path} does not exist; {mesh.name} needs this label file (data.labels={labels!r})"
        )
    _inside(root, path)
    return path


def _lines(path: Path) -> list[str]:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot read the list of meshes ({error})") from error
    return [line.strip() for line in lines if line.strip()]
