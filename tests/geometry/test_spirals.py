"""The spiral operator has the properties that Lim et al. 2018, section 3.1, define it by."""

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


# ---------------------------------------------------------------- a second, literal implementation


def clockwise_ring(mesh: Mesh, v: int) -> list[list[int]]:
    """The fans around v, each clockwise, found face by face."""
    after = {}
    for a, b, c in mesh.faces.tolist():
        for x, y, z in ((a, b, c), (b, c, a), (c, a, b)):
            if x == v:
                after[z] = y  # the face is wound x y z; clockwise around x, z comes before y
    fans = []
    starts = [x for x in after if x not in after.values()]
    left = set(after) | set(after.values())
    while left:
        x = starts.pop() if starts else min(left)
        fan = []
        while x in left:
            left.remove(x)
            fan.append(x)
            x = after.get(x, -1)
        fans.append(fan)
    return fans


def literal_spiral(rings: dict[int, list[int]], v: int, start: int, length: int) -> list[int]:
    """The definition, word for word as a queue."""
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
    neighbours = [set() for _ in mesh.vertices]
    for face in mesh.faces.tolist():
        for x in face:
            neighbours[x] |= set(face) - {x}
    return neighbours


def breadth_first(neighbours, v: int) -> dict[int, int]:
    distance, front, step = {v: 0}, {v}, 0
    while front:
        step += 1
        front = {x for u in front for x in neighbours[u]} - distance.keys()
        distance |= dict.fromkeys(front, step)
    return distance


def rows_of(table, v):
    return table.sequences[table.first[v] : table.first[v + 1]]


# ------------------------------------------------------------------------------------ one-rings


@every_mesh
def test_one_rings_are_clockwise_fans(mesh):
    neighbours, first = one_rings(mesh)
    for v in range(len(mesh.vertices)):
        ring = neighbours[first[v] : first[v + 1]].tolist()
        fans = clockwise_ring(mesh, v)
        if len(fans) == 1 and ring:  # a cycle may begin anywhere
            k = ring.index(fans[0][0])
            ring = ring[k:] + ring[:k]
            assert ring == fans[0]
        else:
            assert sorted(ring) == sorted(x for fan in fans for x in fan)
            for fan in fans:  # each fan is contiguous, and clockwise up to its entry
                where = [ring.index(x) for x in fan]
                assert sorted(where) == list(range(min(where), max(where) + 1))
                k = where.index(min(where))
                assert where[k:] + where[:k] == sorted(where)


def test_an_open_fan_begins_and_ends_at_the_boundary():
    mesh = lattice(3, 3)
    neighbours, first = one_rings(mesh)
    assert neighbours[first[1] : first[2]].tolist() == [0, 3, 4, 2]


# ------------------------------------------------------------------------------------- spirals


def test_a_regular_lattice_gives_the_textbook_spiral():
    """Clockwise as seen from +z, from the neighbour in direction +x, outwards ring by ring."""
    n = 9
    rows = rows_of(spiral_table(lattice(n, n), 19), 4 * n + 4)
    one = [(0, 1), (-1, 1), (-1, 0), (0, -1), (1, -1), (1, 0)]
    # the two-ring begins with what the first and the last of the one-ring share
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
def test_the_table_agrees_with_the_literal_definition(mesh):
    table = spiral_table(mesh, 30)
    neighbours, first = one_rings(mesh)
    rings = {v: neighbours[first[v] : first[v + 1]].tolist() for v in range(len(mesh.vertices))}
    for v, ring in rings.items():
        expected = [literal_spiral(rings, v, start, 30) for start in ring or [None]]
        assert rows_of(table, v).tolist() == expected


@every_mesh
def test_one_row_for_each_directed_edge_that_leads_along_it(mesh):
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
def test_no_vertex_repeats_and_whole_rings_are_breadth_first_rings(mesh):
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
    """Of two two-ring vertices that share a one-ring neighbour, the first clockwise comes first."""
    table = spiral_table(mesh, rings=2)
    neighbours, first = one_rings(mesh)
    around = adjacency(mesh)
    pairs = 0
    for v in range(len(mesh.vertices)):
        for row in rows_of(table, v).tolist():
            valence = len(around[v])
            one, two = row[1 : 1 + valence], [x for x in row[1 + valence :] if x >= 0]
            place = {x: i for i, x in enumerate(two)}
            for i, u in enumerate(one):
                ring = neighbours[first[u] : first[u + 1]].tolist()
                k = ring.index(one[i - 1])  # clockwise around u from the one before it
                order = [x for x in ring[k + 1 :] + ring[: k + 1] if x in place]
                places = [place[x] for x in order]
                if u == one[-1] and places[-1:] == [0]:
                    places.pop()  # a cycle, cut here: what it shares with the first stands there
                assert places == sorted(places)
                pairs += max(0, len(order) - 1)
    assert pairs > 1000  # the loop did look at some


def canonical(table, name) -> list[list[list[int]]]:
    """The rows of each vertex under new names, sorted: where the starts begin is arbitrary."""
    rows = []
    for v in range(len(table.first) - 1):
        renamed = [[name[x] if x >= 0 else -1 for x in row] for row in rows_of(table, v).tolist()]
        rows.append(sorted(renamed))
    return [rows[v] for v in np.argsort([name[v] for v in range(len(name))])]


@every_mesh
def test_renumbering_the_mesh_renumbers_the_spirals(mesh):
    rng = np.random.default_rng(5)
    new_name = rng.permutation(len(mesh.vertices))  # vertex v is called new_name[v]
    vertices = np.empty_like(mesh.vertices)
    vertices[new_name] = mesh.vertices
    faces = new_name[mesh.faces][rng.permutation(len(mesh.faces))]
    turn = rng.integers(0, 3, len(faces))
    faces = np.stack([faces[np.arange(len(faces)), (turn + i) % 3] for i in range(3)], 1)
    other = spiral_table(Mesh(vertices, faces), 30)
    old_name = np.argsort(new_name)
    expected = canonical(spiral_table(mesh, 30), np.arange(len(new_name)))
    assert canonical(other, old_name) == expected


@every_mesh
def test_a_mirrored_mesh_reverses_the_sense_of_rotation(mesh):
    mirrored = Mesh(mesh.vertices * [-1, 1, 1], mesh.faces[:, ::-1])
    ring, first = one_rings(mesh)
    other, _ = one_rings(mirrored)
    for v in range(len(mesh.vertices)):
        if len(clockwise_ring(mesh, v)) == 1:
            a, b = ring[first[v] : first[v + 1]].tolist(), other[first[v] : first[v + 1]].tolist()
            k = b.index(a[-1])
            assert b[k:] + b[:k] == a[::-1]


@every_mesh
def test_a_shorter_table_is_the_beginning_of_a_longer_one(mesh):
    long = spiral_table(mesh, 30)
    for length in (1, 2, 7, 15):
        short = spiral_table(mesh, length)
        np.testing.assert_array_equal(short.sequences, long.sequences[:, :length])
        np.testing.assert_array_equal(short.first, long.first)


@every_mesh
def test_by_rings_is_by_length_cut_after_the_ring(mesh):
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


def test_a_start_inside_an_open_fan_goes_on_over_the_gap():
    mesh = lattice(3, 3)
    ring = [0, 3, 4, 2]  # around vertex 1, on the boundary
    rows = rows_of(spiral_table(mesh, 5), 1).tolist()
    assert sorted(rows) == sorted([1, *ring[k:], *ring[:k]] for k in range(4))


def test_a_vertex_without_a_face_has_one_row():
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], [[0, 1, 2]])
    table = spiral_table(mesh, 4)
    assert rows_of(table, 3).tolist() == [[3, -1, -1, -1]]
    assert rows_of(table, 0).tolist() == [[0, 2, 1, -1], [0, 1, 2, -1]]
    assert spiral_table(Mesh([[0, 0, 0]], []), 3).sequences.tolist() == [[0, -1, -1]]


def test_a_component_smaller_than_the_length_is_padded_and_never_left():
    mesh = union(Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), bumpy_sphere())
    table = spiral_table(mesh, 20)
    for v in range(3):
        for row in rows_of(table, v).tolist():
            assert set(row[:3]) == {0, 1, 2} and row[3:] == [-1] * 17


@pytest.mark.parametrize("mesh", [bow_tie(), two_cones()], ids=["bow tie", "two cones"])
def test_where_fans_meet_all_of_them_are_listed_whatever_the_numbering(mesh):
    count = len(mesh.vertices)
    row = rows_of(spiral_table(mesh, count), 0)
    assert all(sorted(r.tolist()) == list(range(count)) for r in row)
    neighbours, _ = one_rings(mesh)
    distance = np.linalg.norm(mesh.vertices, axis=1)
    if (
        mesh.faces.shape[0] == 10
    ):  # a closed fan is entered at its nearest vertex, nearest fan first
        nearest = [1 + distance[1:6].argmin(), 6 + distance[6:11].argmin()]
        nearest.sort(key=lambda v: distance[v])
        assert neighbours[0] == nearest[0] and neighbours[5] == nearest[1]


def test_many_rings_on_rags_end():
    mesh = punctured(bumpy_sphere(3, 3), 0.4)
    table = spiral_table(mesh, len(mesh.vertices) + 10)
    assert (table.sequences[:, -10:] == -1).all()


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((0,), "length must be at least 1, got 0"),
        ((), "either length or rings"),
        ((5, 2), "either length or rings"),
        ((None, -1), "rings must be at least 0, got -1"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    length, rings = (*arguments, None, None)[:2]
    with pytest.raises(ValueError, match=message):
        spiral_table(lattice(3, 3), length, rings=rings)
