"""The command `meshes`: its table and its error messages."""

from __future__ import annotations

import pytest

from meshspiral.commands.meshes import COLUMNS, main
from meshspiral.data.statistics import MeshStatistics

REMESHED = "data=bodies_remeshed"
REMESH = ["data/remesh=mixed", "data.remesh.vertices=120"]


def test_every_statistic_has_a_column():
    assert len(COLUMNS) == len(MeshStatistics._fields)


def test_the_table_shows_every_mesh_of_a_split(cli, toy_overrides):
    data = [o for o in toy_overrides if o.startswith("data") and "shot" not in o]
    code, out, err = cli(*data, *REMESH, "split=test", program=main)
    assert code == 0, err
    lines = [line.split() for line in out.splitlines() if line.startswith(("test_", "mean"))]
    assert [line[0] for line in lines] == ["test_0", "test_1", "test_2", "mean"]
    for line in lines[:-1]:
        assert 114 <= int(line[1]) <= 120 and line[4:8] == ["yes", "yes", "0", "yes"]
    assert float(lines[-1][10]) < 0.8  # shared edges
    code, out, err = cli(*data, "split=test", program=main)  # as registered
    lines = [line.split() for line in out.splitlines() if line.startswith("test_")]
    assert code == 0 and all(line[7] == "-" and line[10:] == ["1.00", "-", "-"] for line in lines)
    code, out, err = cli(*data, *REMESH, "data.val=[val/0.ply]", "split=val", program=main)
    # the shared edges of a single mesh are undefined
    assert code == 0 and out.splitlines()[-2].split()[10] == "-"
    code, out, err = cli(*data, "data.val=[]", "split=val", program=main)
    assert code == 1 and "the split val must have at least 1 mesh, got 0" in out + err


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["split=exam"], "split must be one of train, val, test, got exam"),
        ([REMESHED, "data.remesh.policy=knitted"], "data.remesh.policy must be one of"),
        ([REMESHED, "data.remesh.vertices=3"], "data.remesh.vertices must be at least 12"),
        ([REMESHED, "+data.remesh.depth=3"], "unknown key data.remesh.depth"),
    ],
)
def test_a_mistake_gives_a_one_line_error(cli, arguments, message):
    code, out, err = cli(*arguments, program=main)
    assert code == 1 and message in (out + err).strip().splitlines()[-1]
