"""Correspondences between triangle meshes, learned from spirals of vertices (Lim et al. 2018).

    from meshspiral import Matcher, open_scan

    match = Matcher.load().match(open_scan("a.ply"), open_scan("b.obj"))
    match.target[v]  # the vertex of b.obj that corresponds to vertex v of a.ply

The names below are imported on first use, so that `import meshspiral` loads no library.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from meshspiral.data.scans import open_scan, scan
    from meshspiral.geometry.mesh import Mesh
    from meshspiral.matching.matcher import Matcher

__all__ = ["Matcher", "Mesh", "open_scan", "scan"]

_MODULES = {
    "Matcher": "meshspiral.matching.matcher",
    "Mesh": "meshspiral.geometry.mesh",
    "open_scan": "meshspiral.data.scans",
    "scan": "meshspiral.data.scans",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
