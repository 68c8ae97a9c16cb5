"""Imports between the folders of the package point in one direction."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "src" / "meshspiral"

# What each folder may import beside itself.
ALLOWED = {
    "geometry": set(),
    "nn": set(),
    "neighbourhoods": {"geometry"},
    "data": {"geometry", "neighbourhoods"},
    "experiment": {"geometry", "neighbourhoods", "nn", "data"},
    "viz": {"geometry", "data"},
    "evaluation": {"geometry", "neighbourhoods", "nn", "data", "experiment", "viz"},
}
ALLOWED["training"] = {*ALLOWED["evaluation"], "evaluation"}
ALLOWED["matching"] = {*ALLOWED["training"], "training"}
ALLOWED["reporting"] = ALLOWED["matching"]
ALLOWED["benchmarking"] = ALLOWED["matching"]
ALLOWED["commands"] = {*ALLOWED, "training", "experiment"}
ALLOWED["meshspiral"] = {"matching", "data", "geometry"}  # what `import meshspiral` offers

# Of experiment, the library knows the settings and the run folder; the rest is for commands alone.
PUBLIC = {"schema", "run_folder"}

HEAVY = {"hydra", "omegaconf", "lightning", "torchmetrics"}
FOREIGN = {  # packages that a folder must not import
    "geometry": HEAVY | {"torch", "pydantic"},
    "nn": HEAVY | {"numpy", "scipy", "numba", "trimesh", "potpourri3d"},
    "neighbourhoods": HEAVY,
}


def imports(source: str) -> set[str]:
    """The full names of all modules, and of all names in them, that a source imports anywhere."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide where they point"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def folder_of(module: str) -> str:
    """meshspiral.data.cache -> data."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and (PACKAGE / parts[1]).is_dir() else "meshspiral"


def violations(folder: str, source: str) -> set[str]:
    names = imports(source)
    ours = {name for name in names if name.split(".")[0] == "meshspiral"}
    others = {name.split(".")[0] for name in names}
    private = {
        name
        for name in ours
        if folder not in ("experiment", "commands")
        and folder_of(name) == "experiment"
        and name.split(".")[2] not in PUBLIC
    }
    folders = {folder_of(name) for name in ours}
    return (folders - ALLOWED[folder] - {folder}) | private | (others & FOREIGN.get(folder, set()))


MODULES = sorted(PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_module_imports_only_what_its_folder_may(path):
    dotted = ".".join(["meshspiral", *path.relative_to(PACKAGE).with_suffix("").parts])
    assert violations(folder_of(dotted), path.read_text()) == set()


def test_no_two_folders_import_each_other():
    for folder, others in ALLOWED.items():
        for other in others & ALLOWED.keys():
            assert folder not in ALLOWED[other], f"{folder} and {other}"


def test_a_forbidden_import_is_found():
    assert violations("geometry", "def f():\n    import torch") == {"torch"}
    assert violations("nn", "from meshspiral.data.cache import Cache") == {"data"}
    assert violations("data", "from meshspiral import nn\nimport meshspiral.nn.layers") == {"nn"}
    runs = "meshspiral.experiment.runs.claim"
    assert violations("training", "from meshspiral.experiment.runs import claim") == {runs}
    assert violations("experiment", "import meshspiral.training.run") == {"training"}
    assert violations("training", "from meshspiral.experiment.schema import TrainConfig") == set()
    assert violations("viz", "from meshspiral.evaluation import metrics") == {"evaluation"}


def test_the_package_has_at_most_12_folders():
    folders = [path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file()]
    assert len(folders) <= 12


def test_the_library_has_one_identity():
    """`src.meshspiral` would be a second copy of every class."""
    import meshspiral
    import src

    assert Path(meshspiral.__file__).parent == PACKAGE
    assert Path(src.__file__).parent == PACKAGE.parent
    with pytest.raises(ImportError):
        import src.meshspiral.geometry
