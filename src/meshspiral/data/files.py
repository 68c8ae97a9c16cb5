"""Files that appear whole or not at all, and legal names for them."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import re
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np


@contextlib.contextmanager
def atomic_file(path: Path, sync: bool = False) -> Iterator[BinaryIO]:
    """Open a temporary file that takes the place of `path` once the block has ended.

    If the block fails, the temporary file is removed and `path` stays as it was.

    Args:
        path: The file to write. Its folder must exist.
        sync: Wait until the content is on the disk, so that it survives a power failure.
    """
    temporary = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        with open(temporary, "xb") as file:  # permissions follow the umask
            yield file
            if sync:
                file.flush()
                os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(path)  # a full disk names no file
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


def write_file(path: Path, content: str | bytes) -> None:
    """Write text or bytes to a file that appears whole or not at all."""
    with atomic_file(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def write_arrays(path: Path, **arrays: np.ndarray) -> None:
    """Write a compressed .npz file that appears whole or not at all."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_file(path, buffer.getvalue())


def legal_name(name: str) -> str:
    """A file name of at most 130 bytes, without special characters or a leading dot.

    Different names stay different.
    """
    legal = re.sub(r"^\.+|[^\w.+-]+", "-", name).encode()[:120].decode(errors="ignore")
    if legal != name:  # what was lost may be what tells two names apart
        legal += "-" + hashlib.sha256(name.encode()).hexdigest()[:8]
    return legal
