"""A cache of arrays on disk; the key hashes everything that a result depends on."""

from __future__ import annotations

import inspect
import logging
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np

from meshspiral.data.files import atomic_file
from meshspiral.geometry.digest import digest
from meshspiral.neighbourhoods.base import Arrays

log = logging.getLogger(__name__)


class CacheError(OSError):
    """The cache cannot be written. The message names the folder and the reason."""


@cache
def code_version(*modules: ModuleType) -> str:
    """A hash of the modules' source code, so that a change of code invalidates its results."""
    return digest(*(inspect.getsource(module) for module in modules))


class Cache:
    """A folder of .npz files, one per result, named by kind and key.

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
        return self.root / kind / f"{key}.npz"

    def has(self, kind: str, key: str) -> bool:
        """Whether there is a file for a result; its content is not checked."""
        return self.path(kind, key).is_file()

    def load(self, kind: str, key: str) -> Arrays | None:
        """Load the arrays of a result; None if its file is missing, damaged or foreign."""
        path = self.path(kind, key)
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}  # reading checks the CRC
        except FileNotFoundError:
            return None
        except (
            OSError,
            ValueError,
            EOFError,
            KeyError,
            TypeError,
            RuntimeError,
            zipfile.BadZipFile,
            zlib.error,
        ) as error:
            log.warning("%s is damaged (%s); computing it again", path, error)
            return None
        if arrays.pop("key", np.array([])).tolist() != [key, *sorted(arrays)]:
            log.warning("%s holds another result than its name says; computing it again", path)
            return None
        return arrays

    def save(self, kind: str, key: str, arrays: Arrays) -> None:
        """Save the arrays of a result, replacing its file if there is one.

        Raises:
            CacheError: The folder cannot be written.
        """
        path = self.path(kind, key)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_file(path) as file:
                np.savez(file, key=np.array([key, *sorted(arrays)]), **arrays)
        except OSError as error:
            reason = error.strerror or error
            raise CacheError(
                f"cannot write the cache {self.root} ({reason}); check its free space and "
                "permissions, or choose another folder with data.cache_dir=/path/to/folder"
            ) from error

    def get(self, kind: str, key: str, compute: Callable[[], Arrays]) -> Arrays:
        """Load the arrays of a result, or compute and save them.

        Args:
            kind: Kind of the result, the name of a subfolder.
            key: Hash of everything that the result depends on.
            compute: Computes the arrays.

        Raises:
            CacheError: The folder cannot be written.
        """
        arrays = self.load(kind, key)
        if arrays is None:
            arrays = compute()
            self.save(kind, key, arrays)
        return arrays

    def size(self) -> int:
        """Total size of all results in bytes."""
        total = 0
        for path in self.root.rglob("*.npz"):
            try:
                total += path.stat().st_size
            except OSError:  # another process is replacing it
                continue
        return total
