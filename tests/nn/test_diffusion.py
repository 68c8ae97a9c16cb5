"""DiffusionNet: diffusion in closed form, features that do not see the axes, renumbering."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from meshspiral.geometry.gradients import tangent_axes
from meshspiral.geometry.mesh import Mesh
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.neighbourhoods import operators as module
from meshspiral.nn.diffusion import DiffusionBlock, LearnedDiffusion, SurfaceOperators
from meshspiral.nn.geodesic import Resampling, resample
from meshspiral.nn.networks import DiffusionNet
from tests.meshes import bumpy_sphere, icosphere, lattice, union


def operators(mesh: Mesh, eigenfunctions: int = 16) -> SurfaceOperators:
    """In float64, as far as they are kept."""
    settings = module.Operators.Settings(name="operators", eigenfunctions=eigenfunctions)
    neighbourhood = Neighbourhood.of(settings)
    served = neighbourhood.tensors(neighbourhood.compute(mesh), mesh)["operators"]
    gradients = Resampling(**served.pop("gradients"))
    return SurfaceOperators(**served, gradients=gradients).to(torch.float64)


def harmonics(points: np.ndarray) -> np.ndarray:
    """Spherical harmonics of degrees 0, 1, 2 and 2, up to their norms, float [V, 4]."""
    x, y, z = points.T
    return np.stack([np.ones_like(x), z, x * y, 3 * z**2 - 1], axis=1)


@pytest.mark.parametrize("scale", [1.0, 7.0])
def test_harmonics_on_a_sphere_decay_as_the_heat_equation_says(scale):
    sphere = icosphere(3)
    x = torch.from_numpy(harmonics(sphere.vertices))
    layer = LearnedDiffusion(4).double()
    times = torch.tensor([0.02, 0.01, 0.02, 0.005], dtype=torch.float64)
    layer.time.data.copy_(times)
    found = layer(x, operators(Mesh(scale * sphere.vertices, sphere.faces)))
    degrees = torch.tensor([0.0, 1, 2, 2], dtype=torch.float64)
    # of area 1: the radius is 1 / sqrt(4 pi), and the eigenvalues are 4 pi l (l + 1)
    decay = torch.exp(-4 * np.pi * degrees * (degrees + 1) * times)
    torch.testing.assert_close(found, x * decay, atol=0.02, rtol=0)


def test_times_are_learnt_from_the_start_and_stay_positive():
    sphere = icosphere(2)
    layer = LearnedDiffusion(4).double()
    x = torch.from_numpy(harmonics(sphere.vertices))
    layer(x, operators(sphere)).square().sum().backward()
    assert (layer.time.grad[1:] < 0).all()  # longer diffusion, less energy
    layer.time.data.fill_(-1.0)
    layer(x, operators(sphere))
    assert (layer.time > 0).all()


def test_gradients_of_linear_functions_on_a_plane_are_exact():
    plane = lattice(6, 6)
    slopes = torch.tensor([[0.5, -2.0], [3.0, 1.0]], dtype=torch.float64)
    values = torch.from_numpy(plane.vertices[:, :2]) @ slopes
    found = resample(values, operators(plane).gradients).view(-1, 2, 2)
    axes = torch.from_numpy(tangent_axes(plane.vertex_normals)[:, :, :2])
    expected = plane.size * axes @ slopes
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


def block(channels: int = 6) -> DiffusionBlock:
    torch.manual_seed(0)
    made = DiffusionBlock(channels, 0.5).double().eval()
    made.diffusion.time.data.fill_(0.01)
    return made


def test_the_directions_of_the_axes_do_not_matter(monkeypatch):
    mesh, x = bumpy_sphere(), torch.randn(162, 6, dtype=torch.float64)
    expected = block()(x, operators(mesh))
    turns = np.random.default_rng(0).uniform(0, 2 * np.pi, 162)
    cos, sin = np.cos(turns)[:, None], np.sin(turns)[:, None]

    def turned(normals):
        a, b = np.swapaxes(tangent_axes(normals), 0, 1)
        return np.stack([cos * a + sin * b, cos * b - sin * a], axis=1)

    monkeypatch.setattr(module.gradients, "tangent_axes", turned)
    found = block()(x, operators(mesh))
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


def test_a_reflected_surface_has_other_features():
    mesh, x = bumpy_sphere(), torch.randn(162, 6, dtype=torch.float64)
    reflected = Mesh(mesh.vertices * [1, 1, -1], mesh.faces[:, ::-1])
    difference = block()(x, operators(reflected)) - block()(x, operators(mesh))
    assert difference.abs().max() > 0.01


def make(classes: int = 21) -> DiffusionNet:
    torch.manual_seed(0)
    return DiffusionNet(10, classes, width=12, blocks=2).double().eval()


def test_renumbering_a_mesh_renumbers_the_scores():
    mesh, x = bumpy_sphere(subdivisions=3), torch.randn(642, 10, dtype=torch.float64)
    order = np.random.default_rng(0).permutation(642)
    expected = make()(x, operators(mesh))[order]
    found = make()(x[order], operators(mesh.renumbered(order)))
    # up to float32, in which operators are kept
    torch.testing.assert_close(found, expected, atol=1e-3, rtol=1e-3)


def test_gradients_of_the_network_against_finite_differences():
    sphere = icosphere(1)
    around, net = operators(sphere, 8), make(3)
    x = torch.randn(42, 10, dtype=torch.float64, requires_grad=True)
    # with torch.autograd.gradcheck: inputs, and through them every layer
    assert torch.autograd.gradcheck(lambda x: net(x, around)[:5], (x,), fast_mode=True)


def test_all_parameters_learn():
    net = make().train()
    x = torch.randn(162, 10, dtype=torch.float64)
    net(x, operators(bumpy_sphere())).square().sum().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad.abs().sum() > 0, name


def test_meshes_smaller_than_the_basis_and_in_pieces_are_borne():
    for mesh in (icosphere(1), union(bumpy_sphere(0), bumpy_sphere(1))):
        x = torch.randn(len(mesh.vertices), 10, dtype=torch.float64)
        assert torch.isfinite(make()(x, operators(mesh, 128))).all()


def test_the_network_is_the_stack_of_its_layers():
    mesh, x = bumpy_sphere(), torch.randn(162, 10, dtype=torch.float64)
    net, around = make(), operators(mesh)
    net.feature_scale = 3.0
    expected = net.lift(3 * x)
    for each in net.blocks:
        diffused = each.diffusion(expected, around)
        gradients = resample(diffused, around.gradients).view(162, 2, -1)
        read = torch.cat([expected, diffused, each.features(gradients)], dim=1)
        expected = expected + each.perceptron(read)
    torch.testing.assert_close(net(x, around), net.head(expected), atol=1e-6, rtol=1e-6)
