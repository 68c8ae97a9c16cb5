"""Geometry vectors: the sums of the splines, isometries, signs and bases, tessellations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from meshspiral.data.datasets.bodies import Bodies
from meshspiral.geometry.barycentric import interpolate
from meshspiral.geometry.geovec import cubic_spline, geometry_vectors
from meshspiral.geometry.laplacian import Spectrum, spectrum
from meshspiral.geometry.mesh import Mesh
from meshspiral.geometry.remesh import remesh
from tests.geometry.test_sampling import split_faces
from tests.meshes import bumpy_sphere, icosphere, lattice

CHANNELS = 20


def vectors(mesh: Mesh, largest: float = 60.0, count: int = 60) -> np.ndarray:
    """Of eigenvalues times the area, as the descriptor takes them."""
    values, functions, masses = spectrum(mesh, count)
    found = Spectrum(values * mesh.area, functions * np.sqrt(mesh.area), masses / mesh.area)
    return geometry_vectors(found, CHANNELS, 4 * np.pi * largest)


def test_the_spline_is_smooth_and_has_integral_1():
    assert quad(cubic_spline, 0, 4)[0] == pytest.approx(1)
    x = np.linspace(-1, 5, 6001)
    second = np.diff(cubic_spline(x), 2) / 1e-6
    assert np.abs(np.diff(second)).max() < 0.01  # twice continuously differentiable
    assert cubic_spline(np.array([0.0, 1, 2, 3, 4])) == pytest.approx([0, 1 / 6, 2 / 3, 1 / 6, 0])


def test_the_weights_of_an_eigenvalue_sum_to_0_a_sixth_five_sixths_and_1():
    knots = np.arange(50)
    sums = [cubic_spline(x - knots).sum() for x in (0.0, 1.0, 2.0, 3.0, 3.7, 20.2, 49.0)]
    np.testing.assert_allclose(sums, [0, 1 / 6, 5 / 6, 1, 1, 1, 1], atol=1e-12)


def test_the_constant_function_has_no_part():
    values, functions, masses = spectrum(icosphere(2), 30)
    changed = functions.copy()
    changed[:, 0] *= np.linspace(1, 9, len(masses))
    one, two = (
        geometry_vectors(Spectrum(values, f, masses), 10, 20.0) for f in (functions, changed)
    )
    np.testing.assert_allclose(one, two, atol=1e-9)


def test_rows_have_length_1():
    rows = vectors(bumpy_sphere(subdivisions=3))
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1)


def test_a_sheet_bent_to_a_cylinder_keeps_its_vectors():
    sheet = lattice(24, 20)
    x, y, _ = sheet.vertices.T
    radius = 9.0  # about two radians; an edge becomes a chord, shorter by 1 part in 2000
    bent = np.stack([radius * np.sin(x / radius), y, radius * np.cos(x / radius)], axis=1)
    flat, round_ = vectors(sheet), vectors(Mesh(bent, sheet.faces))
    assert np.linalg.norm(flat - round_, axis=1).max() < 0.03
    assert np.linalg.norm(flat - flat.mean(0), axis=1).mean() > 0.1


def test_scale_signs_and_bases_do_not_matter():
    mesh = bumpy_sphere(subdivisions=3)
    scaled = Mesh(7 * mesh.vertices, mesh.faces)
    np.testing.assert_allclose(vectors(scaled), vectors(mesh), atol=1e-6)
    mesh = icosphere(3)  # with repeated eigenvalues
    _, functions, masses = spectrum(mesh, 36)
    turned = functions.copy()
    rng = np.random.default_rng(0)
    for degree in range(6):
        own = slice(degree**2, (degree + 1) ** 2)
        basis, _ = np.linalg.qr(rng.normal(size=(2 * degree + 1,) * 2))
        turned[:, own] = functions[:, own] @ basis
    # made exactly those of a sphere
    values = np.concatenate([np.full(2 * d + 1, d * (d + 1.0)) for d in range(6)])
    one, two = (
        geometry_vectors(Spectrum(values, f, masses), 10, 20.0) for f in (functions, turned)
    )
    np.testing.assert_allclose(one, two, atol=1e-9)


def test_two_tessellations_of_a_body_agree():
    body = Bodies(1500).load("s0_a_pose").mesh
    finer = split_faces(body, np.arange(0, len(body.faces), 3))
    one, two = vectors(body), vectors(finer)[: len(body.vertices)]
    difference = np.linalg.norm(one - two, axis=1)
    apart = np.linalg.norm(one - one[np.random.default_rng(0).permutation(1500)], axis=1)
    assert np.median(difference) < 0.3 * np.median(apart)


def test_a_surface_and_its_remesh_agree():
    """In the lower bands: the higher the frequency, the more the triangles matter."""
    source = bumpy_sphere(1, subdivisions=3, bump=0.4)
    made = remesh(source, 500, "simplified", seed=0)
    one = interpolate(vectors(source, 20, 30), source.faces[made.faces], made.weights)
    two = vectors(made.mesh, 20, 30)
    distances = np.linalg.norm(one[:, None] - two, axis=2)
    own = distances.diagonal()
    assert np.median(own) < 0.3 * np.median(distances)
    assert (distances < own[:, None]).mean() < 0.02  # few other vertices are as near
