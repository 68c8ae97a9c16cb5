"""Each fast network against the same network written plainly: one loss, one gradient."""

import pytest
import torch

from meshspiral.benchmarking.measure import fast_loss
from meshspiral.benchmarking.reference import PlainNetwork
from meshspiral.nn.networks import GCNN3, FCSNet, LSTMNet
from tests.nn.test_geodesic import as_resampling, patches
from tests.nn.test_layers import sequences

NETWORKS = {
    "fcs": lambda: FCSNet(10, 21, 6, channels=[5, 6, 7], dropout=0.0, feature_scale=2.0),
    "lstm": lambda: LSTMNet(10, 21, channels=[5, 6, 7], dropout=0.0, feature_scale=2.0),
    "gcnn3": lambda: GCNN3(10, 21, channels=[5, 6, 7], dropout=0.0, feature_scale=2.0),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_losses_and_gradients_agree_to_1e_9(name):
    torch.manual_seed(0)
    net = NETWORKS[name]().double()
    plain = PlainNetwork(net)
    features, labels = torch.randn(30, 10, dtype=torch.float64), torch.randint(21, (30,))
    neighbourhood = (
        as_resampling(*patches(30)) if name == "gcnn3" else sequences(30, 6, padded=False)
    )
    ours = fast_loss(net, features, neighbourhood, labels)
    theirs = plain.loss(features, neighbourhood, labels)
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-9)
    ours.backward(), theirs.backward()
    for get in (lambda n: n.lift.weight, lambda n: n.neck.weight, lambda n: n.head.weight):
        assert get(net).grad.abs().max() > 1e-6
        torch.testing.assert_close(get(net).grad, get(plain).grad, rtol=0, atol=1e-9)
