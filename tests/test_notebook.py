"""The notebooks run, and are committed without outputs."""

from __future__ import annotations

import nbformat
import pytest
from nbclient import NotebookClient

from tests.helpers import ROOT, run

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_no_outputs_are_committed(path):
    for cell in nbformat.read(path, as_version=4).cells:
        assert not cell.get("outputs") and not cell.get("execution_count")


def test_the_notebook_shows_a_run(toy_overrides, tmp_path, monkeypatch):
    metrics = run(tmp_path / "run", [*toy_overrides, "optim.epochs=10", "metric=true"])
    monkeypatch.setenv("RUN", str(tmp_path / "run"))
    notebook = nbformat.read(ROOT / "notebooks" / "run.ipynb", as_version=4)
    NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(ROOT)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any(f"{metrics['parameters']:,}" in output.get("text", "") for output in outputs)
    images = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(images) == 3  # the curve, correspondences, errors
    assert any("are predicted alike" in output.get("text", "") for output in outputs)


def test_the_notebook_matches_two_meshes():
    notebook = nbformat.read(ROOT / "notebooks" / "match.ipynb", as_version=4)
    NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(ROOT)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("median confidence" in output.get("text", "") for output in outputs)
    assert any("image/png" in output.get("data", {}) for output in outputs)
