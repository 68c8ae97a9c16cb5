"""The networks of Lim et al. 2018: numbers of parameters, layers, metric information, dropout."""

import pytest
import torch

from meshspiral.nn.networks import GCNN3, ConvNet, FCSNet, LSTMNet
from tests.nn.test_geodesic import as_resampling, patches


def parameters(net):
    return sum(p.numel() for p in net.parameters())


def test_lstm_net_has_the_parameters_of_table_1():
    assert parameters(LSTMNet(544, 6890)) == 2_675_706


@pytest.mark.parametrize("length, count", [(15, 2_530_356), (20, 2_763_356), (30, 3_229_356)])
def test_fcs_net_has_the_parameters_of_table_1(length, count):
    assert parameters(FCSNet(544, 6890, length)) == count


def test_gcnn3_has_the_parameters_of_table_1():
    assert parameters(GCNN3(544, 6890)) == 2_672_634


@pytest.mark.parametrize("length", [20, 25, 30])
def test_conv_net_has_about_as_many_parameters_as_the_others(length):
    assert parameters(ConvNet(544, 6890, length)) == pytest.approx(2.7e6, rel=0.06)


def test_the_first_dense_layer_may_be_wider():
    fcs, n = parameters(FCSNet(544, 6890, 20)), 20
    added = 64 - 16
    assert parameters(FCSNet(544, 6890, n, lifted=64)) == fcs + added * (544 + 1) + n * added * 100


def test_metric_information_adds_two_channels_to_the_layers_that_take_it():
    fcs, n = parameters(FCSNet(544, 6890, 20)), 20
    assert parameters(FCSNet(544, 6890, n, metric=True)) == fcs + 2 * n * (100 + 150 + 200)
    first = FCSNet(544, 6890, n, metric=True, metric_layers="first")
    assert parameters(first) == fcs + 2 * n * 100
    lstm = parameters(LSTMNet(544, 6890))
    assert parameters(LSTMNet(544, 6890, metric=True)) == lstm + 2 * 4 * (150 + 200 + 250)


def make(name, metric=False, **options):
    torch.manual_seed(0)
    if name in ("fcs", "conv"):
        network = FCSNet if name == "fcs" else ConvNet
        return network(10, 21, 6, channels=[5, 6, 7], metric=metric, **options)
    return LSTMNet(10, 21, channels=[5, 6, 7], metric=metric, **options)


@pytest.fixture
def batch():
    torch.manual_seed(1)
    spirals = torch.stack([torch.randperm(30)[:6] for _ in range(30)])
    return torch.randn(30, 10), spirals, torch.rand(30, 6, 2)


@pytest.mark.parametrize("name", ["fcs", "lstm", "conv"])
@pytest.mark.parametrize("metric", [False, True])
def test_scores_have_one_column_per_template_vertex(name, metric, batch):
    features, spirals, extra = batch
    scores = make(name, metric)(features, spirals, extra if metric else None)
    assert scores.shape == (30, 21)


@pytest.mark.parametrize("name", ["fcs", "lstm", "conv"])
def test_renumbering_vertices_renumbers_the_scores(name, batch):
    features, spirals, _ = batch
    net = make(name).eval().double()
    order = torch.randperm(30)
    inverse = torch.argsort(order)
    renumbered = net(features[order].double(), inverse[spirals[order]])
    torch.testing.assert_close(renumbered, net(features.double(), spirals)[order])


@pytest.mark.parametrize("name", ["fcs", "lstm", "conv"])
def test_metric_information_must_be_given_if_and_only_if_the_network_reads_it(name, batch):
    features, spirals, extra = batch
    with pytest.raises(ValueError, match="with metric"):
        make(name, metric=True)(features, spirals)
    with pytest.raises(ValueError, match="without metric"):
        make(name)(features, spirals, extra)


@pytest.mark.parametrize("name", ["fcs", "lstm", "conv"])
@pytest.mark.parametrize("metric_layers, count", [("all", 3), ("first", 1)])
def test_metric_information_reaches_the_chosen_layers(name, metric_layers, count, batch):
    features, spirals, extra = batch
    net = make(name, metric=True, metric_layers=metric_layers)
    net(features, spirals, extra).sum().backward()
    reached = [
        layer.metric is not None and bool(layer.metric.weight.grad.any()) for layer in net.layers
    ]
    assert reached == [True] * count + [False] * (3 - count)


def test_an_unknown_value_of_metric_layers_is_rejected():
    with pytest.raises(ValueError, match="metric_layers must be one of"):
        make("fcs", metric=True, metric_layers="some")


def test_dropout_is_off_in_evaluation_and_on_in_training(batch):
    features, spirals, _ = batch
    net = make("fcs")
    assert not torch.equal(net(features, spirals), net(features, spirals))
    net.eval()
    assert torch.equal(net(features, spirals), net(features, spirals))


def test_the_forget_gate_starts_open():
    layer = LSTMNet(10, 21).layers[0]
    i, f, g, o = layer.input.bias.chunk(4)
    assert (f == 3).all() and not any(gate.any() for gate in (i, g, o))


@pytest.mark.parametrize("cls", [FCSNet, LSTMNet])
def test_vertices_differ_after_three_layers(cls):
    """With a forget bias of 1 and smaller weights, vertices hardly differed in LSTM-NET."""
    torch.manual_seed(0)
    net = cls(544, 10, **({"seq_len": 20} if cls is FCSNet else {}))
    x = torch.relu(torch.randn(300, 16))
    spirals = torch.randint(300, (300, 20))
    spirals[:, 0] = torch.arange(300)
    for layer in net.layers:
        x = torch.relu(layer(x, spirals))
    assert x.std(dim=0).mean() > 0.015


@pytest.mark.parametrize("name", ["fcs", "lstm", "conv"])
def test_a_network_is_the_stack_of_its_layers_with_relu_between(name, batch):
    features, spirals, _ = batch
    net = make(name, feature_scale=3.0).eval()
    x = torch.relu(net.lift(3.0 * features))
    for layer in net.layers:
        x = torch.relu(layer(x, spirals))
    x = torch.relu(net.neck(x))
    torch.testing.assert_close(net.embed(features, spirals), x)
    torch.testing.assert_close(net(features, spirals), net.head(x))


def test_gcnn3_is_the_stack_of_its_layers_with_relu_between():
    torch.manual_seed(0)
    net = GCNN3(10, 21, channels=[5, 6, 7], feature_scale=3.0).eval()
    features, resampling = torch.randn(30, 10), as_resampling(*patches(30))
    x = torch.relu(net.lift(3.0 * features))
    for layer in net.layers:
        x = torch.relu(layer(x, resampling))
    x = torch.relu(net.neck(x))
    torch.testing.assert_close(net.embed(features, resampling), x)
    torch.testing.assert_close(net(features, resampling), net.head(x))
    net.train()
    assert not torch.equal(net(features, resampling), net(features, resampling))  # dropout


def test_the_first_ray_of_a_patch_does_not_matter_to_gcnn3():
    net = GCNN3(10, 21, channels=[5, 6, 7]).eval().double()
    features, table = torch.randn(30, 10).double(), patches(30)
    turned = [x.roll(5, 1) for x in table]
    scores = [net(features, as_resampling(*t)) for t in (table, turned)]
    torch.testing.assert_close(*scores, rtol=0, atol=1e-12)


def test_dropout_follows_the_first_and_the_last_dense_layer(batch):
    features, spirals, _ = batch
    net = make("fcs", dropout=0.9)
    with torch.no_grad():
        for layer in (net.lift, net.neck):
            layer.bias.fill_(100.0)  # only dropout gives zeros
        inputs = []
        net.layers[0].register_forward_hook(lambda m, args, out: inputs.append(args[0]))
        out = net.embed(features, spirals)
    for x in (inputs[0], out):
        assert (x == 0).float().mean() == pytest.approx(0.9, abs=0.05)
