"""A network trained on the toy data set, for all tests of matching."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers import run


@pytest.fixture(scope="session")
def trained(tmp_path_factory, toy_overrides) -> Path:
    """The run folder of a small GCNN3."""
    folder = tmp_path_factory.mktemp("trained")
    gcnn3 = [o for o in toy_overrides if not o.startswith("seq_len")]
    settings = ["model=gcnn3", "optim.epochs=30", "optim.lr=0.01", "data.shot.radius=0.5"]
    settings += ["model.dropout=0.1"]
    run(folder, [*gcnn3, *settings])
    return folder
