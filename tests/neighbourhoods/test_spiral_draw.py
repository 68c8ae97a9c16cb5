"""One spiral of every vertex, each start equally likely."""

from __future__ import annotations

import numpy as np
import torch

from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.spirals import spiral_table
from meshspiral.neighbourhoods.spiral import draw_spirals
from tests.meshes import bumpy_sphere, lattice, punctured, union


def test_every_start_is_drawn_equally_often():
    mesh = punctured(bumpy_sphere(), 0.2)
    table = spiral_table(mesh, 4)
    sequences, first = torch.from_numpy(table.sequences), torch.from_numpy(table.first)
    generator = torch.Generator().manual_seed(0)
    draws = torch.stack([draw_spirals(sequences, first, generator)[:, 1] for _ in range(600)])
    assert draws.dtype == torch.int64
    for v in range(len(mesh.vertices)):
        starts = table.sequences[table.first[v] : table.first[v + 1], 1]
        counts = np.array([(draws[:, v] == int(s)).sum() for s in starts])
        assert counts.sum() == 600
        assert np.abs(counts - 600 / len(starts)).max() < 6 * np.sqrt(600 / len(starts))


def test_drawn_spirals_are_rows_of_their_vertex():
    table = spiral_table(union(lattice(3, 3), Mesh([[0, 0, 0]], [])), 5)
    drawn = draw_spirals(torch.from_numpy(table.sequences), torch.from_numpy(table.first))
    for v, row in enumerate(drawn.tolist()):
        assert row in table.sequences[table.first[v] : table.first[v + 1]].tolist()
