"""Polar patches as sparse matrices, in rows and in columns."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from meshspiral.geometry import patches as module
from meshspiral.geometry.geodesics import diameter
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.patches import first_directions, geodesic_patches
from meshspiral.geometry.windows import gaussian_windows
from meshspiral.neighbourhoods.patch import by_rows_and_columns
from tests.conftest import toy_shapes
from tests.meshes import bumpy_sphere, lattice
from tests.neighbourhoods.made import patch


def tensors(neighbourhood, mesh):
    return neighbourhood.tensors(neighbourhood.compute(mesh), mesh)["patches"]


def dense_samples(patches, rings, rays):
    """[V, rays, rings, V] from rows, and from columns."""
    patches = {name: np.asarray(array) for name, array in patches.items()}
    vertices = len(patches["sample_first"]) - 1
    out = np.zeros((2, len(patches["first"]) - 1, vertices))
    for i, (indices, weights, first) in enumerate(
        [("vertices", "weights", "first"), ("samples", "sample_weights", "sample_first")]
    ):
        matrix = out[i].T if i else out[i]
        for row, (begin, end) in enumerate(pairwise(patches[first])):
            np.add.at(matrix[row], patches[indices][begin:end], patches[weights][begin:end])
    return out.reshape(2, vertices, rays, rings, vertices)


def test_patches_are_served_by_rows_and_by_columns():
    mesh = bumpy_sphere()
    served = tensors(patch(), mesh)
    dtypes = {name: str(t.dtype).removeprefix("torch.") for name, t in served.items()}
    assert dtypes == {
        "vertices": "int32",
        "weights": "float32",
        "first": "int32",
        "samples": "int32",
        "sample_weights": "float32",
        "sample_first": "int32",
    }
    table = geodesic_patches(mesh, 0.1 * diameter(mesh), 3, 8, first_directions(mesh))
    expected = np.zeros((162, 3, 8, 162))
    for v, ring, ray, corner in np.ndindex(table.indices.shape):
        at = table.indices[v, ring, ray, corner]
        expected[v, ring, ray, at] += table.weights[v, ring, ray, corner]
    by_rows, by_columns = dense_samples(served, 3, 8)
    np.testing.assert_allclose(by_rows, expected.transpose(0, 2, 1, 3), atol=1e-6)
    np.testing.assert_array_equal(by_columns, by_rows)


def test_a_sample_that_left_the_surface_has_no_entries():
    mesh = lattice(4, 5)
    arrays = patch().compute(mesh)
    turn = first_directions(mesh)
    exists = geodesic_patches(mesh, 0.1 * diameter(mesh), 3, 8, turn).exists.transpose(0, 2, 1)
    assert 0 < exists.mean() < 1
    np.testing.assert_array_equal(np.diff(arrays["first"]), 3 * exists.ravel())
    patches = by_rows_and_columns(arrays, 20)
    by_rows, by_columns = dense_samples(patches, 3, 8)
    np.testing.assert_array_equal(by_columns, by_rows)
    np.testing.assert_allclose(by_rows.sum(3), exists, atol=1e-6)


@pytest.mark.parametrize("width", [2.0, 0.2])
def test_gaussian_windows_are_served_in_the_same_order(width):
    mesh = bumpy_sphere()
    grid = (0.1 * diameter(mesh), 3, 8, first_directions(mesh))
    table = gaussian_windows(mesh, *grid, width)
    expected = np.zeros((162, 3, 8, 162))
    for row, (begin, end) in enumerate(pairwise(table.first)):
        expected.reshape(-1, 162)[row, table.indices[begin:end]] = table.weights[begin:end]
    by_rows, by_columns = dense_samples(
        tensors(patch(weights="gaussian", ring_width=width), mesh), 3, 8
    )
    np.testing.assert_array_equal(by_rows, expected.transpose(0, 2, 1, 3))
    np.testing.assert_array_equal(by_columns, by_rows)


def test_patches_are_the_same_in_every_iteration():
    batch = {"patches": tensors(patch(), bumpy_sphere())}
    assert patch().draw(batch, torch.Generator()) is batch and not patch().random


def test_registered_meshes_have_grids_that_begin_in_directions_of_their_own():
    """What is alike in all of them, such as the first edge of a vertex, would give it away."""
    shapes = toy_shapes()
    a, b, again = (first_directions(shapes[f"train/{i}.ply"]) for i in (0, 1, 0))
    assert np.array_equal(a, again) and np.abs(a - b).min() > 0
    assert np.histogram(np.concatenate([a, b]), 4, (0, 2 * np.pi))[0].min() > 50


def test_patch_radii_follow_the_size_of_the_shape(monkeypatch):
    monkeypatch.setattr(module, "first_directions", lambda mesh: np.zeros(162))
    mesh = bumpy_sphere()
    large = Mesh(1000 * mesh.vertices, mesh.faces)
    small, large = (patch().compute(m) for m in (mesh, large))
    np.testing.assert_allclose(small["weights"], large["weights"], atol=1e-5)
