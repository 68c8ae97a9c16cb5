"""Imports point against the flow of data: mesh -> tensors -> network -> metric -> figure."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

SRC = Path(__file__).parents[1] / "src"

# what each part may import of src; an entry point may import all but another entry point
ALLOWED = {
    "geometry": {"geometry"},
    "nn": {"nn"},
    "data": {"data", "geometry"},
    "metrics": set(),
    "figures": {"geometry"},
    "runs": {"config"},
    "config": set(),
    "render": {"geometry"},
    "callbacks": {"runs", "figures", "metrics", "render"},
    "evaluation": {"data", "metrics", "runs"},
    "correspondence": {"data", "nn", "metrics", "evaluation"},
    "memory": set(),
    "trainer": {"callbacks", "config", "memory"},
    "plain": {"nn"},
    "measure": {"nn", "plain"},
    "growth": {"measure", "memory", "nn", "data"},
    "comparison": {"config", "data", "evaluation", "runs"},
    "tables": {"comparison"},
    "page": {"comparison", "tables", "data", "evaluation", "figures", "geometry", "render"},
    "predictor": {"correspondence", "data", "geometry", "nn", "runs", "trainer"},
    "matching": {"config", "data", "geometry", "predictor", "runs"},
    "exports": {"data", "runs"},
    "matches": {"data", "exports", "figures", "geometry", "matching", "render", "runs"},
    "summary": {"data", "evaluation", "figures", "metrics", "render", "runs"},
    "sweeps": {"runs"},
    "cli": {"config", "runs", "sweeps", "data", "geometry"},
}
ENTRY_POINTS = {"train", "evaluate", "match", "meshes", "report", "benchmark"}
NOT_IN_GEOMETRY = {"torch", "hydra", "omegaconf", "lightning", "torchmetrics"}
NOT_IN_NETWORKS = NOT_IN_GEOMETRY - {"torch"} | {"numpy", "trimesh", "potpourri3d", "numba"}


def imports(source: str) -> set[str]:
    """All modules that a source imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide where they point"
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def violations(part: str, source: str) -> set[str]:
    allowed = ALLOWED.get(part, set(ALLOWED) if part in ENTRY_POINTS else set())
    ours = {name.split(".")[1] for name in imports(source) if name.startswith("src.")}
    others = {name.split(".")[0] for name in imports(source)}
    foreign = {"geometry": NOT_IN_GEOMETRY, "nn": NOT_IN_NETWORKS}.get(part, set())
    return (ours - allowed) | (others & foreign)


MODULES = [path for path in sorted(SRC.rglob("*.py")) if path.name != "__init__.py"]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(SRC)))
def test_imports_point_against_the_flow(path):
    part = path.relative_to(SRC).parts[0].removesuffix(".py")
    assert part in ALLOWED.keys() | ENTRY_POINTS, f"say in ALLOWED what {part} may import"
    assert violations(part, path.read_text()) == set()


def test_a_wrong_import_is_found():
    assert violations("geometry", "def f():\n    import torch") == {"torch"}
    assert violations("nn", "from meshspiral.data.cache import Store") == {"data"}
    assert violations("data", "from src import nn\nimport meshspiral.nn.layers") == {"nn"}
    assert violations("evaluate", "from meshspiral.commands.train import main") == {"train"}
    assert violations("evaluate", "from meshspiral.training.module import Correspondence") == set()


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(SRC)))
def test_modules_stay_small(path):
    assert len(path.read_text().splitlines()) <= 300


README = (SRC.parent / "README.md").read_text()


def test_what_the_readme_links_to_is_there():
    links = re.findall(r"\]\((?!http)([^)]+)\)", README)
    assert len(links) >= 2
    assert [link for link in links if not (SRC.parent / link).exists()] == []
    assert not re.search(r"\b(TODO|TABLE|MINUTES|ROWS)\b", README)


def test_the_readme_has_a_line_for_every_module():
    assert [
        path.name for path in MODULES if not re.search(rf"\b{re.escape(path.name)}", README)
    ] == []
