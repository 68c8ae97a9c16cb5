"""One spiral of every vertex: random starts, starts from the frame, and dilation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from meshspiral.data.tensors import draw
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.sampling import nearest_neighbours
from meshspiral.geometry.shot import local_frames
from meshspiral.geometry.spirals import spiral_table
from tests.meshes import bumpy_sphere, lattice, punctured, union
from tests.neighbourhoods.made import spiral, tensors_of


def drawn_from(neighbourhood, tensors, seed=0, training=False):
    generator = torch.Generator().manual_seed(seed)
    return neighbourhood.draw(tensors, generator, training)["spirals"]


def test_every_start_is_drawn_equally_often():
    mesh, neighbourhood = punctured(bumpy_sphere(), 0.2), spiral(4)
    table, tensors = spiral_table(mesh, 4), tensors_of(mesh, neighbourhood)
    draws = torch.stack([drawn_from(neighbourhood, tensors, seed)[:, 1] for seed in range(600)])
    assert draws.dtype == torch.int64
    for v in range(len(mesh.vertices)):
        starts = table.sequences[table.first[v] : table.first[v + 1], 1]
        counts = np.array([(draws[:, v] == int(s)).sum() for s in starts])
        assert counts.sum() == 600
        assert np.abs(counts - 600 / len(starts)).max() < 6 * np.sqrt(600 / len(starts))


def test_drawn_spirals_are_rows_of_their_vertex():
    mesh = union(lattice(3, 3), Mesh([[0, 0, 0]], []))
    table = spiral_table(mesh, 5)
    for v, row in enumerate(drawn_from(spiral(5), tensors_of(mesh, spiral(5))).tolist()):
        assert row in table.sequences[table.first[v] : table.first[v + 1]].tolist()


def test_a_spiral_from_the_frame_starts_at_the_neighbour_nearest_to_its_axis():
    mesh, neighbourhood = bumpy_sphere(), spiral(6, start="frame")
    spirals = drawn_from(neighbourhood, tensors_of(mesh, neighbourhood)).numpy()
    axes = local_frames(mesh.vertices, 0.8 * np.sqrt(mesh.area))[:, 0].astype(float)
    edges = mesh.vertices[spirals] - mesh.vertices[:, None]
    normals = mesh.vertex_normals
    flat = [x - (x * normals).sum(1, keepdims=True) * normals for x in (axes, edges[:, 1])]
    start_cosine = (flat[0] * flat[1]).sum(1) / np.prod(
        [np.linalg.norm(x, axis=1) for x in flat], 0
    )
    # the widest of the angles between two neighbours bounds the angle to the nearest one
    assert (start_cosine > np.cos(np.pi / 3)).all() and start_cosine.mean() > 0.9


def test_the_frame_gives_every_mesh_the_same_start_and_jitter_one_beside_it():
    mesh = bumpy_sphere()
    fixed, jittered = spiral(6, start="frame"), spiral(6, start="frame", jitter=1)
    tensors = tensors_of(mesh, fixed)
    first = drawn_from(fixed, tensors)
    assert torch.equal(first, drawn_from(fixed, tensors, seed=1, training=True))
    assert torch.equal(first, drawn_from(jittered, tensors, seed=2))  # no jitter in evaluation
    draws = torch.stack([drawn_from(jittered, tensors, s, training=True)[:, 1] for s in range(90)])
    table = spiral_table(mesh, 2)
    for v in range(len(mesh.vertices)):
        ring = table.sequences[table.first[v] : table.first[v + 1], 1].tolist()
        k = ring.index(int(first[v, 1]))
        beside = {ring[k - 1], ring[k], ring[(k + 1) % len(ring)]}
        assert set(draws[:, v].tolist()) == beside


def test_renumbering_renumbers_the_spirals_from_the_frame():
    mesh, neighbourhood = bumpy_sphere(3), spiral(9, start="frame")
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    place = np.argsort(order)
    spirals = drawn_from(neighbourhood, tensors_of(mesh, neighbourhood)).numpy()
    theirs = tensors_of(mesh.renumbered(order), neighbourhood)
    theirs = drawn_from(neighbourhood, theirs, seed=5).numpy()
    np.testing.assert_array_equal(theirs, place[spirals[order]])


def test_without_a_frame_the_start_is_random():
    mesh = union(bumpy_sphere(), lattice(1, 1), lattice(2, 2))  # too few vertices for a frame
    axes = local_frames(mesh.vertices, 0.3)[:, 0]
    assert (nearest_neighbours(mesh, axes)[-5:] == -1).all()
    neighbourhood = spiral(3, start="frame", support=0.3 / np.sqrt(mesh.area))
    tensors = tensors_of(mesh, neighbourhood)
    draws = {tuple(drawn_from(neighbourhood, tensors, seed)[-3].tolist()) for seed in range(20)}
    assert len(draws) == 3


def test_dilation_takes_every_dth_element_of_a_longer_spiral():
    mesh = bumpy_sphere()
    longer = spiral_table(mesh, 16)
    tensors = tensors_of(mesh, spiral(6, dilation=3))
    np.testing.assert_array_equal(tensors["sequences"], longer.sequences[:, ::3])
    layers = spiral(6, dilation=[1, 2, 3])
    drawn = drawn_from(layers, tensors_of(mesh, layers))
    row = drawn_from(spiral(16), tensors_of(mesh, spiral(16)))
    assert [each.shape for each in drawn] == [(len(mesh.vertices), 6)] * 3
    for step, each in zip((1, 2, 3), drawn, strict=True):
        assert torch.equal(each, row[:, ::step][:, :6])
    assert layers.least_vertices == 16


def test_dilation_of_whole_rings_and_of_spirals_that_end():
    mesh = union(lattice(4, 4), lattice(2, 2))
    table = spiral_table(mesh, rings=2)
    tensors = tensors_of(mesh, spiral(20, rings=2, dilation=2))
    np.testing.assert_array_equal(tensors["sequences"], table.sequences[:, ::2])
    assert (tensors["sequences"][-1, 2:] == -1).all()


@pytest.mark.parametrize("dilation", [0, [1, 2], [1, 0, 2], []])
def test_dilation_is_one_number_or_three(dilation):
    with pytest.raises(ValueError, match="at least 1, or three"):
        spiral(6, dilation=dilation)


@pytest.mark.parametrize("start", ["frame", "random"])
def test_pooled_starts_are_the_one_drawn_and_others_evenly_around(start):
    mesh = punctured(bumpy_sphere(), 0.2)
    one, three = spiral(6, start=start), spiral(6, start=start, pooled=3)
    table = spiral_table(mesh, 6)
    single = drawn_from(one, tensors_of(mesh, one), seed=5)
    several = drawn_from(three, tensors_of(mesh, three), seed=5)
    assert several.shape == (len(mesh.vertices), 3, 6)
    assert torch.equal(several[:, 0], single)
    for v, rows in enumerate(several.tolist()):
        own = table.sequences[table.first[v] : table.first[v + 1]].tolist()
        first = own.index(rows[0])
        assert rows == [own[(first + k * len(own) // 3) % len(own)] for k in range(3)]


def test_pooled_spirals_may_have_a_dilation_for_each_layer():
    mesh = bumpy_sphere()
    layers = spiral(6, dilation=[1, 2, 3], pooled=2)
    drawn = drawn_from(layers, tensors_of(mesh, layers), seed=4)
    assert [each.shape for each in drawn] == 3 * [(len(mesh.vertices), 2, 6)]
    assert torch.equal(drawn[0][:, :, 2], drawn[1][:, :, 1])


def test_jitter_needs_the_frame():
    with pytest.raises(ValueError, match="jitter needs start=frame"):
        spiral(6, jitter=1)


def test_the_draw_depends_on_purpose_and_mesh_alone():
    mesh, neighbourhood = bumpy_sphere(), spiral(6)
    batch = {**tensors_of(mesh, neighbourhood), "features": torch.zeros(1)}
    one, again = (draw(neighbourhood, batch, 0, "a")["spirals"] for _ in range(2))
    assert torch.equal(one, again)
    assert not torch.equal(one, draw(neighbourhood, batch, 0, "b")["spirals"])
