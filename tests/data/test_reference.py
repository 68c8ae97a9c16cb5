"""Geodesic distances on the template: unit, cache, memory, components."""

from __future__ import annotations

import numpy as np
import pytest

from meshspiral.data.cache import Cache
from meshspiral.data.reference import BLOCK, ReferenceDistances
from meshspiral.geometry.geodesics import GeodesicSolver
from meshspiral.geometry.mesh import Mesh
from tests.meshes import bumpy_sphere, icosphere, lattice, union


@pytest.fixture
def reference(tmp_path):
    return ReferenceDistances(icosphere(), Cache(tmp_path))


def test_reference_distances_are_over_the_square_root_of_the_area(reference):
    mesh = reference.template
    rng = np.random.default_rng(0)
    sources, targets = rng.integers(0, len(mesh.vertices), (2, 200))
    exact = np.arccos(np.clip((mesh.vertices[sources] * mesh.vertices[targets]).sum(1), -1, 1))
    distances = reference(sources, targets)
    np.testing.assert_allclose(distances, exact / np.sqrt(mesh.area), atol=0.03)
    assert reference.diameter == pytest.approx(np.pi / np.sqrt(mesh.area), rel=0.02)
    scaled = ReferenceDistances(Mesh(1000 * mesh.vertices, mesh.faces), reference._cache)
    np.testing.assert_allclose(scaled(sources, targets), distances, rtol=1e-4, atol=1e-6)


def test_only_requested_rows_are_computed_and_they_are_cached(reference, monkeypatch):
    computed = []
    row = GeodesicSolver.row
    monkeypatch.setattr(GeodesicSolver, "row", lambda s, v: computed.append(v) or row(s, v))
    reference(np.array([3, 3]), np.array([3, 9]))
    assert computed == list(range(BLOCK))
    reference(np.array([7]), np.array([1]))
    again = ReferenceDistances(reference.template, reference._cache)
    again(np.array([3]), np.array([9]))
    again(np.array([600]), np.array([600]))  # source and target are equal
    assert len(computed) == BLOCK


def test_all_rows_can_be_computed_before(reference, monkeypatch):
    reference.prepare()
    monkeypatch.setattr(GeodesicSolver, "row", None)  # computing now fails
    again = ReferenceDistances(reference.template, reference._cache)
    assert (again(np.arange(642), np.roll(np.arange(642), 1)) > 0).all()


def test_rows_are_mapped_files_that_are_opened_once(reference, monkeypatch):
    rng = np.random.default_rng(1)
    sources, targets = rng.integers(0, 642, (2, 50))
    first = reference(sources, targets)
    assert len(reference._blocks) == 3
    for rows in reference._blocks.values():
        assert not rows.flags.owndata  # not what was computed: that of the file
    monkeypatch.setattr(Cache, "load", None)
    np.testing.assert_array_equal(reference(sources, targets), first)


def test_a_pair_on_two_components_counts_as_the_diameter(tmp_path):
    reference = ReferenceDistances(union(icosphere(1), icosphere(1)), Cache(tmp_path))
    assert reference(np.array([0]), np.array([50]))[0] == pytest.approx(reference.diameter)


def test_the_heat_kernel_is_a_normal_distribution_on_a_plane(tmp_path):
    """Mean squared distance 2 width^2, probabilities in proportion to area and kernel."""
    mesh = lattice(41, 41)
    reference = ReferenceDistances(mesh, Cache(tmp_path))
    width = 2.5 / np.sqrt(mesh.area)
    vertices, weights = reference.heat_kernel(width)
    centre = 20 * 41 + 20
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-5)
    offsets = mesh.vertices[vertices[centre]] - mesh.vertices[centre]
    squared = (offsets**2).sum(axis=1)
    # a normal distribution cut at three standard deviations
    expected = 2 * 2.5**2 * (1 - 5.5 * np.exp(-4.5)) / (1 - np.exp(-4.5))
    assert (weights[centre] * squared).sum() == pytest.approx(expected, rel=0.03)
    own = weights[centre][vertices[centre] == centre].max()
    assert own == weights[centre].max()


@pytest.mark.parametrize("width", [0, 1e-4])
def test_a_narrow_heat_kernel_is_the_vertex_itself(tmp_path, width):
    mesh = union(bumpy_sphere(), Mesh([[0, 0, 0]], []))
    vertices, weights = ReferenceDistances(mesh, Cache(tmp_path)).heat_kernel(width)
    np.testing.assert_array_equal(vertices[:, 0], np.arange(len(mesh.vertices)))
    np.testing.assert_array_equal(weights[:, 0], 1)
