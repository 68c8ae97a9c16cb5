"""Surfaces in NumPy and numba: meshes, connectivity, spirals, descriptors, patches, remeshing."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path


def _compile_anew_for_other_sources() -> None:
    """Let numba keep compiled functions in a folder named by the sources of this package.

    Numba compiles a function again if its own file changes, but not if one that it calls from
    another file does.
    """
    sources = sorted(Path(__file__).parent.glob("*.py"))
    content = hashlib.sha256(b"".join(path.read_bytes() for path in sources))
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    ours = caches / "meshspiral" / "compiled"
    given = os.environ.get("NUMBA_CACHE_DIR")
    if not given or Path(given).parent == ours:  # from a process with other sources
        os.environ["NUMBA_CACHE_DIR"] = str(ours / content.hexdigest()[:16])


_compile_anew_for_other_sources()
