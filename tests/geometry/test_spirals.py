"""Spirals have the properties by which Lim et al. 2018, section 3.1, define them."""

import itertools

import numpy as np
import pytest

from meshspiral.geometry.connectivity import one_rings
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.spirals import spiral_table
from tests.meshes import (
    bow_tie,
    bumpy_sphere,
    lattice,
    punctured,
    random_meshes,
    torus,
    two_cones,
    union,
)

MESHES = random_meshes()
every_mesh = pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)


# ---------------------------------------------------------------- literal reference implementation


def literal_spiral(rings: dict[int, list[int]], v: int, start: int, length: int) -> list[int]:
    """The spiral of v by the definition, with a queue."""
    sequence, appended_by = [v], {v: None}
    i = 0
    while i < len(sequence) and len(sequence) < length:
        u = sequence[i]
        ring = rings[u]
        if i == 0:
            k = ring.index(start) if ring else 0
            order = ring[k:] + ring[:k]
        else:
            before = sequence[i - 1] if sequence[i - 1] in ring else appended_by[u]
            k = ring.index(before)
            order = ring[k + 1 :] + ring[: k + 1]
        for x in order:
            if x not in appended_by:
                appended_by[x] = u
                sequence.append(x)
        i += 1
    return sequence[:length] + [-1] * max(0, length - len(sequence))


def adjacency(mesh: Mesh) -> list[set[int]]:
    """The neighbours of every vertex."""
    neighbours = [set() for _ in mesh.vertices]
    for face in mesh.faces.tolist():
        for x in face:
            neighbours[x] |= set(face) - {x}
    return neighbours


def breadth_first(neighbours, v: int) -> dict[int, int]:
    """The number of edges from v to every vertex of its component."""
    distance, front, step = {v: 0}, {v}, 0
    while front:
        step += 1
        front = {x for u in front for x in neighbours[u]} - distance.keys()
        distance |= dict.fromkeys(front, step)
    return distance


def rows_of(table, v):
    """The spirals of v, [starts, N]."""
    return table.sequences[table.first[v] : table.first[v + 1]]


# ------------------------------------------------------------------------------------- spirals


def test_a_regular_lattice_gives_the_textbook_spiral():
    """Clockwise as seen from +z, from the neighbour in direction +x, ring by ring."""
    n = 9
    rows = rows_of(spiral_table(lattice(n, n), 19), 4 * n + 4)
    one = [(0, 1), (-1, 1), (-1, 0), (0, -1), (1, -1), (1, 0)]
    # the two-ring begins with the common neighbour of the first and the last of the one-ring
    two = [
        (1, 1),
        (0, 2),
        (-1, 2),
        (-2, 2),
        (-2, 1),
        (-2, 0),
        (-1, -1),
        (0, -2),
        (1, -2),
        (2, -2),
        (2, -1),
        (2, 0),
    ]
    expected = [(4 + i) * n + 4 + j for i, j in [(0, 0), *one, *two]]
    assert next(row for row in rows if row[1] == expected[1]).tolist() == expected


@pytest.mark.parametrize("mesh", [lattice(12, 12), torus()], ids=["lattice", "torus"])
def test_on_a_regular_neighbourhood_the_spiral_never_jumps(mesh):
    table = spiral_table(mesh, 37)
    neighbours = adjacency(mesh)
    inner = [
        v
        for v in range(len(mesh.vertices))
        if all(len(neighbours[u]) == 6 for u, d in breadth_first(neighbours, v).items() if d < 3)
    ]
    assert len(inner) >= 9
    for v in inner:
        for row in rows_of(table, v):
            assert all(b in neighbours[a] for a, b in itertools.pairwise(row))


@every_mesh
def test_the_table_agrees_with_the_reference_implementation(mesh):
    table = spiral_table(mesh, 30)
    neighbours, first = one_rings(mesh)
    rings = {v: neighbours[first[v] : first[v + 1]].tolist() for v in range(len(mesh.vertices))}
    for v, ring in rings.items():
        expected = [literal_spiral(rings, v, start, 30) for start in ring or [None]]
        assert rows_of(table, v).tolist() == expected


@every_mesh
def test_each_directed_edge_has_one_row_that_starts_along_it(mesh):
    table = spiral_table(mesh, 5)
    neighbours = adjacency(mesh)
    assert table.sequences.dtype == np.int32 and table.first.dtype == np.int64
    assert table.first.shape == (len(mesh.vertices) + 1,)
    assert table.first[-1] == len(table.sequences)
    for v, around in enumerate(neighbours):
        rows = rows_of(table, v)
        assert (rows[:, 0] == v).all()
        assert sorted(rows[:, 1].tolist()) == sorted(around or [-1])


@every_mesh
def test_no_vertex_repeats_and_complete_rings_are_breadth_first_rings(mesh):
    table = spiral_table(mesh, 40)
    neighbours = adjacency(mesh)
    for v in range(len(mesh.vertices)):
        distance = breadth_first(neighbours, v)
        for row in rows_of(table, v).tolist():
            real = [x for x in row if x >= 0]
            assert len(set(real)) == len(real) == min(40, len(distance))
            assert row[len(real) :] == [-1] * (40 - len(real))
            depths = [distance[x] for x in real]
            assert depths == sorted(depths)
            for depth in set(depths[:-1]) - {depths[-1]}:
                ring = {x for x, d in distance.items() if d == depth}
                assert {x for x in real if distance[x] == depth} == ring


@pytest.mark.parametrize("mesh", [bumpy_sphere(4, 3), torus(15, 17)], ids=["sphere", "torus"])
def test_siblings_are_clockwise_around_their_common_neighbour(mesh):
    """Two vertices of the two-ring with a common neighbour in the one-ring stand in their clockwise
    order around it."""
    table = spiral_table(mesh, rings=2)
    neighbours, first = one_rings(mesh)
    around = adjacency(mesh)
    pairs = 0
    for v in range(len(mesh.vertices)):
        for row in rows_of(table, v).tolist():
            valence = len(around[v])
            one, two = row[1 : 1 + valence], [x for x in row[1 + valence :] if x >= 0]
            position = {x: i for i, x in enumerate(two)}
            for i, u in enumerate(one):
                ring = neighbours[first[u] : first[u + 1]].tolist()
                k = ring.index(one[i - 1])  # clockwise around u from the one before it
                order = [x for x in ring[k + 1 :] + ring[: k + 1] if x in position]
                positions = [position[x] for x in order]
                if u == one[-1] and positions[-1:] == [0]:
                    # the two-ring is a cycle, cut here: the common neighbour with one[0] is first
                    positions.pop()
                assert positions == sorted(positions)
                pairs += max(0, len(order) - 1)
    assert pairs > 1000


def canonical(table, number) -> list[list[list[int]]]:
    """The rows of each vertex under new numbers, sorted, since the first start is arbitrary."""
    rows = []
    for v in range(len(table.first) - 1):
        renamed = [[number[x] if x >= 0 else -1 for x in row] for row in rows_of(table, v).tolist()]
        rows.append(sorted(renamed))
    return [rows[v] for v in np.argsort([number[v] for v in range(len(number))])]


@every_mesh
def test_renumbering_the_mesh_renumbers_the_spirals(mesh):
    rng = np.random.default_rng(5)
    new_number = rng.permutation(len(mesh.vertices))  # vertex v becomes vertex new_number[v]
    vertices = np.empty_like(mesh.vertices)
    vertices[new_number] = mesh.vertices
    faces = new_number[mesh.faces][rng.permutation(len(mesh.faces))]
    turn = rng.integers(0, 3, len(faces))
    faces = np.stack([faces[np.arange(len(faces)), (turn + i) % 3] for i in range(3)], 1)
    other = spiral_table(Mesh(vertices, faces), 30)
    old_number = np.argsort(new_number)
    expected = canonical(spiral_table(mesh, 30), np.arange(len(new_number)))
    assert canonical(other, old_number) == expected


@every_mesh
def test_a_shorter_table_is_a_prefix_of_a_longer_one(mesh):
    long = spiral_table(mesh, 30)
    for length in (1, 2, 7, 15):
        short = spiral_table(mesh, length)
        np.testing.assert_array_equal(short.sequences, long.sequences[:, :length])
        np.testing.assert_array_equal(short.first, long.first)


@every_mesh
def test_a_table_by_rings_is_one_by_length_cut_after_the_last_ring(mesh):
    neighbours = adjacency(mesh)
    for rings in (0, 1, 2, 3):
        table = spiral_table(mesh, rings=rings)
        whole = spiral_table(mesh, table.sequences.shape[1])
        longest = 0
        for v in range(len(mesh.vertices)):
            size = sum(d <= rings for d in breadth_first(neighbours, v).values())
            longest = max(longest, size)
            for row, full in zip(rows_of(table, v), rows_of(whole, v), strict=True):
                np.testing.assert_array_equal(row[:size], full[:size])
                assert (row[size:] == -1).all()
        assert table.sequences.shape[1] == longest


# ---------------------------------------------------------------------------- degenerate cases


def test_a_start_inside_an_open_fan_continues_at_its_other_end():
    mesh = lattice(3, 3)
    ring = [0, 3, 4, 2]  # around vertex 1, on the boundary
    rows = rows_of(spiral_table(mesh, 5), 1).tolist()
    assert sorted(rows) == sorted([1, *ring[k:], *ring[:k]] for k in range(4))


def test_an_isolated_vertex_has_one_row():
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], [[0, 1, 2]])
    table = spiral_table(mesh, 4)
    assert rows_of(table, 3).tolist() == [[3, -1, -1, -1]]
    assert rows_of(table, 0).tolist() == [[0, 2, 1, -1], [0, 1, 2, -1]]
    assert spiral_table(Mesh([[0, 0, 0]], []), 3).sequences.tolist() == [[0, -1, -1]]


def test_a_component_smaller_than_the_length_is_padded():
    mesh = union(Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), bumpy_sphere())
    table = spiral_table(mesh, 20)
    for v in range(3):
        for row in rows_of(table, v).tolist():
            assert set(row[:3]) == {0, 1, 2} and row[3:] == [-1] * 17


@pytest.mark.parametrize("mesh", [bow_tie(), two_cones()], ids=["bow tie", "two cones"])
def test_at_a_bow_tie_a_spiral_covers_all_fans(mesh):
    count = len(mesh.vertices)
    rows = rows_of(spiral_table(mesh, count), 0)
    assert len(rows) == count - 1
    assert all(sorted(row.tolist()) == list(range(count)) for row in rows)


def test_spirals_longer_than_a_fragmented_mesh_are_padded():
    mesh = punctured(bumpy_sphere(3, 3), 0.4)
    table = spiral_table(mesh, len(mesh.vertices) + 10)
    assert (table.sequences[:, -10:] == -1).all()


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((0,), "length must be at least 1, got 0"),
        ((), "either length or rings, got neither"),
        ((5, 2), "either length or rings, got length=5 and rings=2"),
        ((None, -1), "rings must be at least 0, got -1"),
    ],
)
def test_wrong_arguments_are_refused(arguments, message):
    length, rings = (*arguments, None, None)[:2]
    with pytest.raises(ValueError, match=message):
        spiral_table(lattice(3, 3), length, rings=rings)
