"""Arrays on disk under a key of all that they depend on, computed once."""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import logging
import os
import uuid
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np

log = logging.getLogger(__name__)

Arrays = dict[str, np.ndarray]


class StoreError(OSError):
    """The cache can't be written; the message names the folder and the reason."""


def digest(*parts: np.ndarray | str | float | None) -> str:
    """A hexadecimal SHA-256 of arrays (dtype, shape and content) and plain values, in order."""
    sha = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            sha.update(f"|{part.dtype.str}{part.shape}|".encode())
            sha.update(np.ascontiguousarray(part).data)
        else:
            sha.update(f"|{part!r}|".encode())
    return sha.hexdigest()


@cache
def code_version(*modules: ModuleType) -> str:
    """A hash of the modules' source: results of other code are never taken for this one's."""
    return digest(*(inspect.getsource(module) for module in modules))


class Store:
    """A folder of .npz files, one per result, named by kind and key.

    Several processes may use one folder: files appear whole or not at all, and a result computed
    twice is the same result. A file that is truncated, damaged or not one of ours is reported,
    computed again and replaced.
    """

    def __init__(self, root: str | Path):
        self.root = Path(root)

    def path(self, kind: str, key: str) -> Path:
        return self.root / kind / f"{key}.npz"

    def has(self, kind: str, key: str) -> bool:
        return self.path(kind, key).is_file()

    def load(self, kind: str, key: str) -> Arrays | None:
        """The arrays kept under that key; None if there are none, or none that can be trusted."""
        path = self.path(kind, key)
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}  # reading checks each CRC
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
            log.warning("%s is not what its name says; computing it again", path)
            return None
        return arrays

    def save(self, kind: str, key: str, arrays: Arrays) -> None:
        """Keep arrays under a key. Errors: StoreError if the folder can't be written."""
        path = self.path(kind, key)
        temporary = path.with_name(f"{uuid.uuid4().hex}.tmp")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(temporary, "xb") as file:  # as readable for others as the umask says
                np.savez(file, key=np.array([key, *sorted(arrays)]), **arrays)
            os.replace(temporary, path)
        except BaseException as error:
            with contextlib.suppress(OSError):
                temporary.unlink()
            if isinstance(error, OSError):
                reason = error.strerror or error
                raise StoreError(
                    f"cannot write the cache {self.root} ({reason}); "
                    "make room, or choose another folder with data.cache_dir="
                ) from error
            raise

    def get(self, kind: str, key: str, compute: Callable[[], Arrays]) -> Arrays:
        """The arrays under that key, computed and kept if they are not there."""
        arrays = self.load(kind, key)
        if arrays is None:
            arrays = compute()
            self.save(kind, key, arrays)
        return arrays

    def size(self) -> int:
        """Bytes of all results."""
        total = 0
        for path in self.root.rglob("*.npz"):
            try:
                total += path.stat().st_size
            except OSError:  # another process is replacing it
                continue
        return total
