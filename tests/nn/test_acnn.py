"""ACNN: its layers, and kernels as patches."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from meshspiral.geometry.geodesics import diameter
from meshspiral.geometry.mesh import Mesh
from meshspiral.neighbourhoods import Neighbourhood
from meshspiral.neighbourhoods.anisotropic import DIAMETER, Anisotropic
from meshspiral.nn.geodesic import Resampling, resample
from meshspiral.nn.networks import ACNN, GCNN3
from tests.meshes import bumpy_sphere


def kernels(**changes) -> Neighbourhood:
    settings = {
        "times": [24.0, 60.0],
        "angles": 4,
        "anisotropy": 100.0,
        "entries": 5,
        "smoothing": 2,
        "eigenfunctions": None,
    }
    return Neighbourhood.of(Anisotropic.Settings(name="anisotropic", **settings | changes))


def served(mesh: Mesh, neighbourhood: Neighbourhood) -> Resampling:
    tensors = neighbourhood.tensors(neighbourhood.compute(mesh), mesh)
    return Resampling(**tensors["patches"])


def make(**options) -> ACNN:
    torch.manual_seed(0)
    sizes = {"lifted": 4, "channels": (5, 6, 7), "dense": (9, 8), "rings": 2, "rays": 4}
    return ACNN(10, 21, **sizes | options)


def test_batch_normalisation_stands_behind_all_but_the_first_the_linear_and_the_last():
    net = make()
    assert [norm.num_features for norm in net.norms] == [5, 6, 7]
    assert [type(layer) for layer in net.neck] == [nn.Linear, nn.Linear, nn.ReLU, nn.BatchNorm1d]
    assert net.neck[0].bias is None and net.neck[1].bias is not None
    assert net.head.in_features == 8
    assert make(dense=()).head.in_features == 7 and len(make(dense=()).neck) == 0


def test_the_published_sizes():
    net = ACNN(544, 6890)
    weights = [544 * 64 + 64, *(80 * a * b for a, b in [(64, 64), (64, 128), (128, 256)])]
    weights += [2 * (64 + 128 + 256), 256 * 1024, 1024 * 512 + 512, 2 * 512, 512 * 6890 + 6890]
    assert sum(p.numel() for p in net.parameters()) == sum(weights)


def test_samples_are_the_entries_of_the_kernels_times_as_rings_angles_as_rays():
    mesh, neighbourhood = bumpy_sphere(), kernels()
    arrays = neighbourhood.compute(mesh)
    assert arrays["indices"].shape == (162, 4, 2, 5)
    x = torch.randn(162, 3)
    found = resample(x, served(mesh, neighbourhood)).view(162, 4, 2, 3)
    rows = x[torch.from_numpy(arrays["indices"]).long()]
    expected = (rows * torch.from_numpy(arrays["weights"])[..., None]).sum(3)
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("scale", [0.1, 30.0])
def test_kernels_do_not_depend_on_the_unit_of_the_mesh(scale):
    mesh = bumpy_sphere()
    one = kernels().compute(mesh)
    two = kernels().compute(Mesh(scale * mesh.vertices, mesh.faces))
    assert (one["indices"] == two["indices"]).mean() > 0.99
    np.testing.assert_allclose(one["weights"], two["weights"], rtol=0.02, atol=1e-4)
    assert diameter(mesh) != pytest.approx(DIAMETER)


def test_renumbering_a_mesh_renumbers_the_scores():
    mesh, order = bumpy_sphere(), np.random.default_rng(0).permutation(162)
    net, x = make().double().eval(), torch.randn(162, 10, dtype=torch.float64)
    expected = net(x, served(mesh, kernels()))[order]
    found = net(x[order], served(mesh.renumbered(order), kernels()))
    # entries of equal size may be others
    assert ((found - expected).abs().amax(1) < 1e-3).double().mean() > 0.95


def test_gcnn3_reads_the_kernels_too():
    neighbourhood = kernels()
    assert GCNN3.options(neighbourhood) == {"rings": 2, "rays": 4} == ACNN.options(neighbourhood)


def test_the_network_is_the_stack_of_its_layers():
    around, net = served(bumpy_sphere(), kernels()), make().double().eval()
    x = torch.randn(162, 10, dtype=torch.float64)
    for norm in net.norms:  # not the identity
        torch.nn.init.uniform_(norm.running_mean)
    net.feature_scale = 3.0
    expected = torch.relu(net.lift(3 * x))
    for layer, norm in zip(net.layers, net.norms, strict=True):
        expected = norm(torch.relu(layer(expected, around)))
    torch.testing.assert_close(net(x, around), net.head(net.neck(expected)))
