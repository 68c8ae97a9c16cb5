"""Your own registered meshes: a folder, a template, and a split that you write down."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path, PurePath

from meshspiral.data.shapes import SPLITS, DataError, Shape, ShapeSet, read_labels, registered_shape
from meshspiral.geometry.mesh import SUFFIXES, Mesh, read_mesh


class Folder(ShapeSet):
    """Meshes in a folder, each with a file that says which template vertex its vertices match.

    root: the folder. template: a mesh file in it. train, val, test: as in `find_meshes`.
    labels: a mesh's label file, relative to the mesh's own folder, with {stem} for the mesh's name
    without suffix (see `read_labels`); "identity" or None where every mesh has the template's
    vertices in the template's order. A shape is called after its path in root, without suffix and
    with "_" for "/". Errors: DataError where a file is missing or outside root, where two meshes
    would have one name, or where a mesh stands in two splits.
    """

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
                "a folder of your own meshes needs data.root=/path/to/folder and "
                f"data.template=a mesh file in it, got root={root!r}, template={template!r}"
            )
        root = Path(root).expanduser()
        if not root.is_dir():
            raise DataError(f"data.root: {root} is not a folder")
        templates = find_meshes(root, [template])
        if len(templates) != 1:
            raise DataError(f"data.template: {template!r} matches {len(templates)} meshes, not one")
        self._template = templates[0]
        self._meshes: dict[str, Path] = {}
        self._labels: dict[str, Path | None] = {}
        self.names = {split: [] for split in SPLITS}
        owner: dict[Path, str] = {}
        for split, entries in zip(SPLITS, (train, val, test), strict=True):
            for mesh in find_meshes(root, entries):
                other = owner.setdefault(mesh.resolve(), split)
                if other != split:
                    raise DataError(f"{mesh} is in {other} and in {split}; a mesh has one split")
                name = "_".join(mesh.relative_to(root).with_suffix("").parts)
                if name in self._meshes:
                    raise DataError(f"{self._meshes[name]} and {mesh} would both be called {name}")
                self._meshes[name] = mesh
                self._labels[name] = _label_file(root, mesh, labels)
                self.names[split].append(name)
        if not self._meshes:
            raise DataError(f"{root}: train, val and test are all empty")

    @cached_property
    def template(self) -> Mesh:
        return read_mesh(self._template)

    def load(self, name: str) -> Shape:
        if name not in self._meshes:
            raise DataError(f"no mesh is called {name!r}; the first is {next(iter(self._meshes))}")
        mesh, labels = read_mesh(self._meshes[name]), self._labels[name]
        if labels is None:
            return registered_shape(mesh, self.template)
        read = read_labels(labels, len(mesh.vertices))
        return Shape(mesh, read, len(self.template.vertices))


def find_meshes(root: Path, entries: str | Sequence[str] | None) -> list[Path]:
    """The mesh files that `entries` name, each below root, without duplicates.

    entries: file names or glob patterns relative to root, or the path of a `.txt` (absolute, or
    relative to root) with one of these a line; None for no meshes. They are taken in their order,
    a pattern's matches sorted; a pattern leaves out hidden files and files that are no meshes.
    Errors: DataError for an entry that matches no mesh or leads out of root: an absolute path,
    "..", a symbolic link.
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
    if (root / entry).is_file():  # a name may hold brackets that a pattern would read as its own
        matches = [root / entry]
    else:
        try:
            matches = sorted(path for path in root.glob(entry) if not path.name.startswith("."))
        except (ValueError, IndexError, NotImplementedError) as error:
            raise DataError(f"{entry!r} is no file or pattern that I can look for") from error
    meshes = [path for path in matches if path.suffix.lower() in SUFFIXES and path.is_file()]
    if not meshes:
        raise DataError(f"{root}: {entry!r} matches no mesh file ({', '.join(SUFFIXES)})")
    return meshes


def _inside(root: Path, path: Path) -> Path:
    """The real path of a file that must lie in root."""
    real = path.resolve()
    if not real.is_relative_to(root.resolve()):
        raise DataError(f"{path} leads out of {root}, to {real}")
    return real


def _label_file(root: Path, mesh: Path, labels: str | None) -> Path | None:
    if labels is None or labels == "identity":
        return None
    path = mesh.parent / labels.replace("{stem}", mesh.stem)
    if not path.is_file():
        raise DataError(f"{path}: {mesh.name} needs this label file (data.labels={labels!r})")
    _inside(root, path)
    return path


def _lines(path: Path) -> list[str]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot read the list of meshes ({error})") from error
    return [line.strip() for line in lines if line.strip()]
