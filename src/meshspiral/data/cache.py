"""A cache of arrays on disk; the key hashes everything that a result depends on."""

from __future__ import annotations

import ast
import contextlib
import inspect
import logging
import os
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as serialize

from meshspiral.data.files import write_file
from meshspiral.geometry.digest import digest
from meshspiral.neighbourhoods.base import Arrays

log = logging.getLogger(__name__)
SUFFIX = ".safetensors"
TEMPORARY = ".tmp"  # of `atomic_file`; a killed process leaves it
A_DAY = 86400.0
FOLLOWED = ("meshspiral.geometry", "meshspiral.data.datasets")


class CacheError(OSError):
    """The cache cannot be written. The message names the folder and the reason."""


@cache
def code_version(*modules: ModuleType) -> str:
    """A hash of source code, so that a change of code invalidates its results.

    Args:
        modules: Their code counts, and that of all modules of FOLLOWED that they import, directly
            or not.
    """
    sources: dict[str, str] = {}
    found = list(modules)
    while found:
        module = found.pop()
        if module.__name__ not in sources:
            sources[module.__name__] = source = inspect.getsource(module)
            found += _imports(source)
    return digest(*(sources[name] for name in sorted(sources)))


def _imports(source: str) -> list[ModuleType]:
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith(FOLLOWED):
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names if alias.name.startswith(FOLLOWED)}
    return [sys.modules[name] for name in names & sys.modules.keys()]


class Entry(NamedTuple):
    """A file of a cache: its path, its size in bytes, and when it was last read, since 1970."""

    path: Path
    size: int
    read: float


class Cache:
    """A folder of safetensors files, one per result, named by kind and key.

    Several processes may share one folder: files are written atomically, and two processes that
    compute the same key write equal arrays. A truncated, damaged or foreign file is reported with a
    warning, computed again and replaced.

    Args:
        root: The folder; it is created when the first result is saved.
    """

    def __init__(self, root: str | Path):
        self.root = Path(root)

    def path(self, kind: str, key: str) -> Path:
        """The file of a result, whether or not it exists."""
        return self.root / kind / f"{key}{SUFFIX}"

    def has(self, kind: str, key: str) -> bool:
        """Whether there is a file for a result; its content is not checked."""
        return self.path(kind, key).is_file()

    def load(self, kind: str, key: str, check: bool = True, read: bool = True) -> Arrays | None:
        """Load the arrays of a result; None if its file is missing, damaged or foreign.

        The file is mapped into memory: its pages are read when they are used, and processes of one
        machine share them. Changes of the arrays do not reach the file.

        Args:
            kind: Kind of the result.
            key: Its key.
            check: Read everything and compare it with its checksum. Otherwise a file that is too
                short, or not a result of this name, is still recognised.
            read: Whether this counts as the last time that the result was read, see `prune`.
        """
        path = self.path(kind, key)
        try:
            arrays, about = _mapped(path)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, RuntimeError, SafetensorError) as error:
            log.warning("%s is damaged (%s); computing it again", path, error)
            return None
        if about.get("key") != key:
            log.warning("%s holds another result than its name says; computing it again", path)
            return None
        if check and about.get("crc32") != _checksum(arrays):
            log.warning("%s is damaged (wrong checksum); computing it again", path)
            return None
        if read:
            with contextlib.suppress(OSError):  # in a folder of somebody else
                os.utime(path)
        return arrays

    def save(self, kind: str, key: str, arrays: Arrays) -> None:
        """Save the arrays of a result, replacing its file if there is one.

        Raises:
            CacheError: The folder cannot be written.
        """
        arrays = {name: np.asarray(array, order="C") for name, array in arrays.items()}
        content = serialize(arrays, {"key": key, "crc32": _checksum(arrays)})
        self.write(self.path(kind, key), content)

    def write(self, path: Path, content: str | bytes) -> None:
        """Write a file of the cache, whole or not at all.

        Raises:
            CacheError: The folder cannot be written.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_file(path, content)
        except OSError as error:
            reason = error.strerror or error
            raise CacheError(
                f"cannot write the cache {self.root} ({reason}); check its free space and "
                "permissions, or choose another folder with data.cache_dir=/path/to/folder"
            ) from error

    def get(self, kind: str, key: str, compute: Callable[[], Arrays], check: bool = True) -> Arrays:
        """Load the arrays of a result, or compute and save them.

        Args:
            kind: Kind of the result, the name of a subfolder.
            key: Hash of everything that the result depends on.
            compute: Computes the arrays.
            check: See `load`.

        Raises:
            CacheError: The folder cannot be written.
        """
        arrays = self.load(kind, key, check)
        if arrays is None:
            arrays = compute()
            self.save(kind, key, arrays)
        return arrays

    def entries(self) -> list[Entry]:
        """All files of the cache."""
        found = []
        for path in self.root.glob("*/*"):
            if path.suffix in (SUFFIX, ".json", TEMPORARY):
                with contextlib.suppress(OSError):  # another process is replacing it
                    status = path.stat()
                    found.append(Entry(path, status.st_size, status.st_mtime))
        return found

    def size(self) -> int:
        """Total size of all files in bytes."""
        return sum(entry.size for entry in self.entries())

    def damaged(self) -> Iterator[Entry]:
        """The files whose content does not agree with their checksum; each is read."""
        for entry in self.entries():
            kind, key = entry.path.parent.name, entry.path.stem
            if entry.path.suffix == SUFFIX and self.load(kind, key, read=False) is None:
                yield entry

    def prune(self, most: float | None, since: float | None) -> list[Entry]:
        """Remove the files whose last reading is longest ago, and what killed processes left.

        Args:
            most: Bytes that may stay; None for any number.
            since: Remove what was last read before this time, in seconds since 1970; None for no
                such time.

        Returns:
            What was removed.
        """
        entries = sorted(self.entries(), key=lambda entry: -entry.read)
        day_ago = time.time() - A_DAY  # another process may be writing a younger temporary file
        removed = [e for e in entries if e.path.suffix == TEMPORARY and e.read <= day_ago]
        size = 0
        for entry in (e for e in entries if e.path.suffix != TEMPORARY):
            size += entry.size
            old = since is not None and entry.read < since
            if old or (most is not None and size > most):
                removed.append(entry)
        for entry in removed:
            entry.path.unlink(missing_ok=True)
        return removed


def _mapped(path: Path) -> tuple[Arrays, dict[str, str]]:
    """The arrays of a file, and what it says about itself."""
    while True:
        inode = path.stat().st_ino
        with safe_open(path, framework="pt") as file:
            arrays = {name: file.get_tensor(name).numpy() for name in file.keys()}  # noqa: SIM118
            about = file.metadata() or {}
        if path.stat().st_ino == inode:  # else replaced between its header and its arrays
            return arrays, about


def _checksum(arrays: Arrays) -> str:
    value = 0
    for name in sorted(arrays):
        value = zlib.crc32(arrays[name].data, value)
    return str(value)
