"""symmetrize_: an ordinary network that is exactly equivariant, with the norms that it had."""

import copy

import pytest
import torch
from torch import nn
from torchrl.modules import MLP, NoisyLinear

from tests.equivariant import assert_exact, by_dtype, by_group, entries
from tests.point_groups import GROUPS, assert_close, random
from tests.test_isotypic import LARGE
from torchrl_sym.modules import EquivariantMLP, symmetrize_
from torchrl_sym.representations import items, polar, pseudoscalar, regular, scalar


def linears(network):
    return [layer for layer in network.modules() if isinstance(layer, nn.Linear)]


@by_group
@by_dtype
def test_networks_commute_and_keep_their_norms(group, dtype):
    rep, out = entries(group), polar(group) + scalar(group)
    torch.manual_seed(0)
    network = MLP(rep.dim, out.dim, num_cells=[24, 48], activation_class=nn.ELU).to(dtype)
    before = copy.deepcopy(network)
    assert symmetrize_(network, rep, out) is network
    assert_exact(network, rep, out, dtype)
    for old, new in zip(before.parameters(), network.parameters(), strict=True):
        assert_close(new.norm(), old.norm(), 1e-5)
        assert (new - old).abs().max() > 1e-3


@by_group
def test_a_second_time_changes_nothing(group):
    rep = entries(group)
    network = symmetrize_(MLP(rep.dim, rep.dim, num_cells=[24]).double(), rep, rep)
    again = symmetrize_(copy.deepcopy(network), rep, rep)
    for one, other in zip(network.parameters(), again.parameters(), strict=True):
        assert_close(one, other, 1e-13)


def test_what_commutes_already_is_kept():
    rep = entries(GROUPS["D3"])
    network = EquivariantMLP(rep, rep, (12, 24), dtype=torch.float64).dense()
    before = copy.deepcopy(network)
    symmetrize_(network, rep, rep)
    for one, other in zip(before.parameters(), network.parameters(), strict=True):
        assert_close(one, other, 1e-13)


def test_critics_and_single_layers_and_large_groups():
    rep = entries(GROUPS["K4"])
    critic = symmetrize_(
        nn.Sequential(nn.Linear(rep.dim, 8), nn.Tanh(), nn.Linear(8, 1)), rep, scalar(rep.group)
    )
    assert_exact(critic, rep, scalar(rep.group), torch.float32)
    layer = symmetrize_(nn.Linear(rep.dim, 3, bias=False).double(), rep, polar(rep.group))
    assert_exact(layer, rep, polar(rep.group))
    large = polar(LARGE["Ih"]) * 2
    network = symmetrize_(MLP(6, 6, num_cells=[120], activation_class=nn.ReLU).double(), large, large)
    assert_exact(network, large, large)


def test_events_of_several_dimensions():
    group = GROUPS["reflect-y"]
    rep = items(regular(group), polar(group))
    network = nn.Sequential(
        nn.Flatten(-2), nn.Linear(6, 4), nn.ELU(), nn.Linear(4, 6), nn.Unflatten(-1, (2, 3))
    )
    assert_exact(symmetrize_(network.double(), rep, rep), rep, rep)


def test_biases_that_no_element_keeps_become_zero():
    sign = pseudoscalar(GROUPS["reflect-y"])
    layer = nn.Linear(2, 2)
    symmetrize_(layer, sign * 2, sign * 2)
    assert not layer.bias.any() and layer.weight.all()


def test_dropout_between_layers_stays():
    rep = entries(GROUPS["K4"])
    network = MLP(rep.dim, rep.dim, num_cells=[8, 8], dropout=0.5).double()
    assert_exact(symmetrize_(network, rep, rep).eval(), rep, rep)


class Reversed(nn.Sequential):
    def forward(self, x):
        return super().forward(x.flip(-1))


def shared() -> nn.Sequential:
    layer = nn.Linear(12, 12)
    return nn.Sequential(nn.Linear(3, 12), nn.Tanh(), layer, nn.Tanh(), layer, nn.Tanh(), nn.Linear(12, 3))


def between(*layers: nn.Module) -> nn.Sequential:
    return nn.Sequential(nn.Linear(3, 12), *layers, nn.Linear(12, 3))


NORM = {"norm_class": nn.LayerNorm, "norm_kwargs": {"normalized_shape": 12}}
REFUSED = {
    "softmax": (lambda: between(nn.Softmax(-1)), "single entries"),
    "layer norm": (lambda: MLP(3, 3, num_cells=[12], **NORM), "single entries"),
    "a parameter for each entry": (lambda: between(nn.PReLU(12)), "single entries"),
    "convolution": (lambda: nn.Sequential(nn.Conv1d(3, 3, 1), nn.Linear(3, 3)), "single entries"),
    "noisy": (lambda: between(NoisyLinear(12, 12)), "got NoisyLinear"),
    "weight norm": (lambda: nn.utils.parametrizations.weight_norm(nn.Linear(3, 3)), "ParametrizedLinear"),
    "lazy": (lambda: MLP(out_features=3, num_cells=[12]), "call the network first"),
    "recurrent": (lambda: nn.GRU(3, 3), "single entries"),
    "another forward": (lambda: Reversed(nn.Linear(3, 3)), "pass the part that is one"),
    "a list": (lambda: nn.ModuleList([nn.Linear(3, 3)]), "pass the part that is one"),
    "nothing": (lambda: nn.Sequential(nn.Tanh()), "nn.Linear layers"),
    "shared": (shared, "a weight of its own"),
    "hidden size": (lambda: MLP(3, 3, num_cells=[10]), "multiples of 6.*got 10.*next one is 12"),
    "input size": (lambda: MLP(4, 3, num_cells=[12]), r"expected layers of the sizes \[3, 12, 3\].*got"),
    "output size": (lambda: MLP(3, 4, num_cells=[12]), r"expected layers of the sizes \[3, 12, 3\].*got"),
    "taken apart": (
        lambda: nn.Sequential(nn.Linear(3, 12), nn.Unflatten(-1, (2, 6)), nn.Linear(6, 3)),
        r"expected layers of the sizes \[3, 12, 3\].*got",
    ),
}


@pytest.mark.parametrize("make, message", REFUSED.values(), ids=REFUSED)
def test_other_networks_are_refused_and_not_touched(make, message):
    rep, network = polar(GROUPS["D3"]), make()
    before = copy.deepcopy(network)
    with pytest.raises((TypeError, ValueError), match=message):
        symmetrize_(network, rep, rep)
    for one, other in zip(before.parameters(), network.parameters(), strict=True):
        assert isinstance(one, nn.UninitializedParameter) or torch.equal(one, other)


def test_layers_of_which_nothing_is_left_are_refused():
    group = GROUPS["reflect-y"]
    with pytest.raises(ValueError, match=r"only zero commutes.*hidden layer between"):
        symmetrize_(nn.Linear(1, 1), scalar(group), pseudoscalar(group))
    with pytest.raises(ValueError, match="one group"):
        symmetrize_(nn.Linear(1, 1), scalar(group), scalar(GROUPS["K4"]))


@pytest.mark.parametrize("on_copies", [True, False])
def test_copies_of_the_data_keep_the_symmetry_that_training_without_them_loses(on_copies):
    rep = entries(GROUPS["K4"])
    network = symmetrize_(MLP(rep.dim, rep.dim, num_cells=[8]).double(), rep, rep)
    x, target = random(8, rep.dim), random(8, rep.dim, seed=1)
    if on_copies:
        x, target = (rep.orbit(each).flatten(0, 1) for each in (x, target))
    optimizer = torch.optim.SGD(network.parameters(), lr=0.1)
    for _ in range(3):
        optimizer.zero_grad()
        (network(x) - target).square().mean().backward()
        optimizer.step()
    if on_copies:
        assert_exact(network, rep, rep)
    else:
        with pytest.raises(AssertionError):
            assert_exact(network, rep, rep)
