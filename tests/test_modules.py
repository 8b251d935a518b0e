"""Equivariant layers and networks: exact, complete, and of the right size at initialisation."""

import pytest
import torch
from torch import nn
from torchrl.modules import MLP

from tests.equivariant import PAPER, assert_exact, by_dtype, by_group, by_kind, entries, network
from tests.point_groups import GROUPS, assert_close, random
from tests.test_isotypic import LARGE
from tests.test_representations import CASES, acted_matrices, build
from torchrl_sym.modules import EquivariantLinear, EquivariantMLP, InvariantMLP
from torchrl_sym.representations import axial, invariant, polar, pseudoscalar, regular, scalar

# --- exact


@pytest.mark.parametrize("name, group", [case for case in CASES if case[1] in PAPER], ids=lambda v: v)
def test_layers_commute_with_every_representation(name, group):
    rep = build(name, group)
    torch.manual_seed(0)
    there = EquivariantLinear(rep, regular(rep.group, 2), dtype=torch.float64)
    back = EquivariantLinear(regular(rep.group, 2), rep, dtype=torch.float64)
    assert_exact(there, rep, there.out_rep)
    assert_exact(back, back.in_rep, rep)
    assert_exact(nn.Sequential(there, nn.ELU(), back), rep, rep)


@by_dtype
@by_group
@by_kind
def test_networks_commute(kind, group, dtype):
    module = network(group, kind, dtype=dtype)
    assert_exact(module, module.in_rep, module.out_rep, dtype)


@pytest.mark.parametrize("group", ["T", "Ih"])
def test_networks_commute_under_large_groups(group):
    for dtype, tolerance in ((torch.float32, 1e-6), (torch.float64, 1e-12)):
        module = EquivariantMLP(polar(LARGE[group]) * 2, polar(LARGE[group]), (240,), dtype=dtype)
        assert_exact(module, module.in_rep, module.out_rep, dtype, tolerance)


@by_group
@by_kind
def test_networks_commute_after_training_with_any_data(kind, group):
    module = network(group, kind, dtype=torch.float64)
    optimizer = torch.optim.Adam(module.parameters(), lr=0.01)
    before = [p.detach().clone() for p in module.parameters()]
    x, target = random(32, module.in_rep.dim), random(32, module.out_rep.dim, seed=1)
    for _ in range(20):
        optimizer.zero_grad()
        (module(x) - target).square().mean().backward()
        optimizer.step()
    assert all((a - b).abs().max() > 0.01 for a, b in zip(before, module.parameters(), strict=True))
    assert_exact(module, module.in_rep, module.out_rep)


@by_kind
def test_bfloat16_is_exact_to_its_rounding(kind):
    module = network(GROUPS["D3"], kind).bfloat16()
    assert_exact(module, module.in_rep, module.out_rep, torch.bfloat16, tolerance=0.05)


def test_a_dense_network_is_not_exact():
    """The check can fail."""
    rep = entries(GROUPS["K4"])
    with pytest.raises(AssertionError):
        assert_exact(MLP(rep.dim, rep.dim, num_cells=[16]).double(), rep, rep)
    module = network(GROUPS["K4"], relaxed=True, dtype=torch.float64)
    with torch.no_grad():
        module.linears[0].free_weight[0, 0] = 1e-3
    with pytest.raises(AssertionError):
        assert_exact(module, rep, module.out_rep)


# --- complete: all maps that commute, and each of them once


def intertwiners(in_rep, out_rep) -> int:
    """Dimension of the space of maps that commute, by characters."""
    characters = [acted_matrices(r).diagonal(dim1=1, dim2=2).sum(-1) for r in (in_rep, out_rep)]
    return round((characters[0] * characters[1]).mean().item())


@pytest.mark.parametrize("name, group", CASES[::3], ids=lambda value: value)
def test_free_numbers_are_as_many_as_there_are(name, group):
    rep = build(name, group)
    for source, target in ((rep, regular(rep.group)), (regular(rep.group), rep), (rep, rep)):
        assert EquivariantLinear(source, target).weight.numel() == intertwiners(source, target)


@by_group
def test_layers_span_the_whole_space(group):
    rep, other = entries(group), polar(group) + regular(group)
    layer = EquivariantLinear(rep, other, bias=True, dtype=torch.float64)
    weights, biases = [], []
    with torch.no_grad():
        for parameter, found, at in ((layer.weight, weights, 0), (layer.bias, biases, 1)):
            for position in range(parameter.numel()):
                layer.weight.zero_(), layer.bias.zero_()
                parameter[position] = 1.0
                found.append(layer.dense_parameters()[at].flatten())
    # independently: the projection of everything there is
    rho_in, rho_out = acted_matrices(rep), acted_matrices(other)
    projection = torch.einsum("gac,gbd->abcd", rho_out, rho_in).flatten(2).flatten(0, 1) / len(rho_in)
    invariants = rho_out.mean(0)
    for found, space in ((weights, projection), (biases, invariants)):
        found = torch.stack(found)
        assert torch.linalg.matrix_rank(found) == len(found) == torch.linalg.matrix_rank(space)
        assert_close(found @ space.T, found)


@by_group
def test_regular_layers_have_a_fraction_of_the_numbers(group):
    layer = EquivariantLinear(regular(group, 8), regular(group, 16))
    assert layer.weight.numel() * group.order == layer.in_rep.dim * layer.out_rep.dim
    assert layer.bias.numel() * group.order == layer.out_rep.dim


# --- at initialisation


def spread(module, x, draws=500) -> torch.Tensor:
    """Mean square per output over draws of the parameters."""
    found = []
    with torch.no_grad():
        for _ in range(draws):
            for part in module.modules():
                if hasattr(part, "reset_parameters"):
                    part.reset_parameters()
            found.append(module(x).square().mean(0))
    return torch.stack(found).mean(0)


@pytest.mark.parametrize("group", ["K4", "C3", "D3"])
@pytest.mark.parametrize("direction", ["in", "between", "out"])
def test_outputs_vary_as_those_of_a_linear_layer(group, direction):
    torch.manual_seed(0)
    group = GROUPS[group]
    hidden, rep = regular(group, 4), entries(group)
    reps = {"in": (rep, hidden), "between": (hidden, regular(group, 2)), "out": (hidden, rep)}
    source, target = reps[direction]
    x = torch.randn(32, source.dim)
    ours = spread(EquivariantLinear(source, target, bias=False), x)
    dense = spread(nn.Linear(source.dim, target.dim, bias=False), x)
    assert (ours / dense.mean()).sub(1).abs().max() < 0.25
    assert (ours.mean() / dense.mean()).sub(1).abs() < 0.1


def test_biases_vary_as_those_of_a_linear_layer():
    torch.manual_seed(0)
    group = GROUPS["D3"]
    x = torch.zeros(1, 5 * group.order)
    for target in (regular(group), invariant(group, 4)):
        ours = spread(EquivariantLinear(regular(group, 5), target), x)
        assert (ours * 3 * x.shape[-1]).sub(1).abs().max() < 0.25
    sign = EquivariantLinear(regular(group, 5), pseudoscalar(group))
    assert sign.bias.numel() == 0 and not sign(x).any()


def test_networks_vary_as_dense_ones():
    torch.manual_seed(0)
    rep = entries(GROUPS["K4"])
    x = torch.randn(64, rep.dim)
    ours = spread(EquivariantMLP(rep, rep, (64, 64)), x, 200).mean()
    dense = spread(MLP(rep.dim, rep.dim, num_cells=[64, 64], activation_class=nn.ELU), x, 200).mean()
    assert abs(ours / dense - 1) < 0.1


# --- refusals


def test_sizes_are_multiples_of_the_order():
    rep = polar(GROUPS["D3"])
    with pytest.raises(
        ValueError, match=r"num_cells: expected multiples of 6.*got 128; the next one is 132"
    ):
        EquivariantMLP(rep, rep, (12, 128))


@pytest.mark.parametrize("wrong", [lambda: nn.Softmax(-1), lambda: nn.LayerNorm(16), lambda: nn.GLU()])
def test_nonlinearities_of_several_entries_are_refused(wrong):
    rep = polar(GROUPS["D3"])
    with pytest.raises(ValueError, match="activation_class: expected a nonlinearity of single entries"):
        EquivariantMLP(rep, rep, (12,), wrong)


@pytest.mark.parametrize("right", [nn.ReLU, nn.SiLU, nn.Tanh, nn.PReLU, nn.Softsign, nn.GELU])
def test_nonlinearities_of_single_entries_are_taken(right):
    rep = entries(GROUPS["K4"])
    module = EquivariantMLP(rep, rep, (12,), right, dtype=torch.float64)
    assert_exact(module, rep, rep)


def test_maps_that_can_only_be_zero_are_refused():
    group = GROUPS["reflect-y"]
    with pytest.raises(ValueError, match="only zero commutes"):
        EquivariantLinear(scalar(group), pseudoscalar(group))
    with pytest.raises(ValueError, match="expected representations of one group"):
        EquivariantLinear(scalar(group), scalar(GROUPS["K4"]))


def test_value_of_state_and_action():
    group = GROUPS["K4"]
    state, action = polar(group) * 3, axial(group)
    critic = InvariantMLP(state + action, num_cells=(16, 16), dtype=torch.float64)
    assert_exact(critic, state + action)
    assert critic(random(2, 12)).shape == (2, 1)
