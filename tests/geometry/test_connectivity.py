"""One-rings are clockwise fans, and the fans of every vertex are counted."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.geometry.connectivity import fans, one_rings
from meshspiral.geometry.mesh import Mesh
from tests.meshes import bow_tie, lattice, random_meshes, two_cones

MESHES = random_meshes()
every_mesh = pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)


def clockwise_fans(mesh: Mesh, v: int) -> list[tuple[list[int], bool]]:
    """The fans around v, found face by face: the neighbours, clockwise, and whether it is open."""
    after = {}
    for a, b, c in mesh.faces.tolist():
        for x, y, z in ((a, b, c), (b, c, a), (c, a, b)):
            if x == v:
                after[z] = y  # the face is wound x y z; clockwise around x, z comes before y
    found = []
    starts = [x for x in after if x not in after.values()]
    left = set(after) | set(after.values())
    while left:
        is_open = bool(starts)
        x = starts.pop() if starts else min(left)
        fan = []
        while x in left:
            left.remove(x)
            fan.append(x)
            x = after.get(x, -1)
        found.append((fan, is_open))
    return found


@every_mesh
def test_one_rings_are_clockwise_fans(mesh):
    neighbours, first = one_rings(mesh)
    for v in range(len(mesh.vertices)):
        ring = neighbours[first[v] : first[v + 1]].tolist()
        expected = clockwise_fans(mesh, v)
        assert sorted(ring) == sorted(x for fan, _ in expected for x in fan)
        for fan, is_open in expected:
            begin = min(ring.index(x) for x in fan)
            part = ring[begin : begin + len(fan)]
            shift = 0 if is_open else fan.index(part[0])  # a closed fan may begin anywhere
            assert part == fan[shift:] + fan[:shift]


@every_mesh
def test_fans_are_counted(mesh):
    expected = [len(clockwise_fans(mesh, v)) for v in range(len(mesh.vertices))]
    assert fans(mesh).tolist() == expected


def test_an_open_fan_begins_and_ends_at_the_boundary():
    neighbours, first = one_rings(lattice(3, 3))
    assert neighbours[first[1] : first[2]].tolist() == [0, 3, 4, 2]


def test_where_closed_fans_meet_each_begins_at_its_nearest_vertex_and_the_nearest_comes_first():
    mesh = two_cones()
    neighbours, _ = one_rings(mesh)
    distance = np.linalg.norm(mesh.vertices, axis=1)  # from vertex 0
    nearest = sorted([1 + distance[1:6].argmin(), 6 + distance[6:11].argmin()], key=distance.item)
    assert neighbours[[0, 5]].tolist() == nearest


def test_the_order_of_open_fans_does_not_depend_on_the_numbering():
    mesh = bow_tie()
    neighbours, first = one_rings(mesh)
    ring = neighbours[first[0] : first[1]]
    for seed in range(5):
        order = np.random.default_rng(seed).permutation(len(mesh.vertices))
        other, first = one_rings(mesh.renumbered(order))
        v = order.tolist().index(0)
        assert order[other[first[v] : first[v + 1]]].tolist() == ring.tolist()


@every_mesh
def test_mirroring_a_mesh_reverses_its_one_rings(mesh):
    mirrored = Mesh(mesh.vertices * [-1, 1, 1], mesh.faces[:, ::-1])
    ring, first = one_rings(mesh)
    other, _ = one_rings(mirrored)
    for v in range(len(mesh.vertices)):
        if len(clockwise_fans(mesh, v)) == 1:
            a, b = ring[first[v] : first[v + 1]].tolist(), other[first[v] : first[v + 1]].tolist()
            k = b.index(a[-1])
            assert b[k:] + b[:k] == a[::-1]
