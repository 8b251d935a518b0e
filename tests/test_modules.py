"""Equivariant layers and networks: exact, complete, of the right size, and ordinary modules otherwise."""

import copy
import math
import pickle

import pytest
import torch
from torch import nn
from torchrl.modules import MLP

from tests.point_groups import GROUPS, assert_close, random
from tests.test_isotypic import LARGE
from tests.test_representations import CASES, acted_matrices, build, every_case
from torchrl_sym import PointGroup
from torchrl_sym.modules import EquivariantLinear, EquivariantMLP, InvariantMLP
from torchrl_sym.representations import axial, invariant, polar, pseudoscalar, regular, scalar
from torchrl_sym.testing import assert_equivariant

PAPER = ["reflect-y", "K4", "C3", "C4", "D3", "D4"]
TOLERANCE = {torch.float32: 1e-6, torch.float64: 1e-12}
by_dtype = pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
by_group = pytest.mark.parametrize("group", PAPER)


def assert_exact(module, in_rep, out_rep=None, dtype=torch.float64, tolerance=None):
    """Equivariant, flat or not, and not just zero."""
    x = random(16, *in_rep.event_shape, dtype=dtype)
    out_rep = invariant(in_rep.group, module(x).shape[-1]) if out_rep is None else out_rep
    y = module(x)
    assert y.dtype == dtype and y.abs().max() > 1e-3
    for g in range(in_rep.group.order):
        expected = out_rep(y, g)
        error = (module(in_rep(x, g)) - expected).abs().max() / y.abs().max().clamp(min=1.0)
        assert error <= (TOLERANCE[dtype] if tolerance is None else tolerance)


def entries(group: PointGroup):
    """A little of everything, dense blocks included."""
    return polar(group) * 2 + axial(group) + pseudoscalar(group) + scalar(group) + regular(group, 2)


def network(group: PointGroup, kind=EquivariantMLP, **kwargs):
    torch.manual_seed(0)
    rep = entries(group)
    sizes = (2 * group.order, 3 * group.order)
    if kind is InvariantMLP:
        return InvariantMLP(rep, 2, sizes, **kwargs)
    if kind is EquivariantLinear:
        return EquivariantLinear(rep, polar(group) + axial(group) + scalar(group), **kwargs)
    return EquivariantMLP(rep, polar(group) + axial(group) + scalar(group), sizes, **kwargs)


def out_rep(module):
    return module.out_rep


KINDS = [EquivariantLinear, EquivariantMLP, InvariantMLP]
by_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)


# --- exact


@every_case
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
    module = network(GROUPS[group], kind, dtype=dtype)
    assert_exact(module, module.in_rep, module.out_rep, dtype)


@pytest.mark.parametrize("group", ["T", "Ih"])
def test_networks_commute_under_large_groups(group):
    for dtype, tolerance in ((torch.float32, 1e-6), (torch.float64, 1e-12)):
        module = EquivariantMLP(polar(LARGE[group]) * 2, polar(LARGE[group]), (240,), dtype=dtype)
        assert_exact(module, module.in_rep, module.out_rep, dtype, tolerance)


@by_group
@by_kind
def test_networks_commute_after_training_with_any_data(kind, group):
    module = network(GROUPS[group], kind, dtype=torch.float64)
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
    rep, other = entries(GROUPS[group]), polar(GROUPS[group]) + regular(GROUPS[group])
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
    group = GROUPS[group]
    layer = EquivariantLinear(regular(group, 8), regular(group, 16))
    assert layer.weight.numel() * group.order == layer.in_rep.dim * layer.out_rep.dim
    assert layer.bias.numel() * group.order == layer.out_rep.dim


# --- at initialisation


def spread(module, x, draws=1000) -> torch.Tensor:
    """Mean square per output over draws of the parameters."""
    found = []
    with torch.no_grad():
        for _ in range(draws):
            for part in module.modules():
                if hasattr(part, "reset_parameters"):
                    part.reset_parameters()
            found.append(module(x).square().mean(0))
    return torch.stack(found).mean(0)


@pytest.mark.parametrize("group", ["reflect-y", "K4", "C3", "D3"])
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


# --- dense(), relaxation()


@by_dtype
@by_kind
@pytest.mark.parametrize("relaxed", [False, True])
def test_dense_has_equal_outputs(kind, dtype, relaxed):
    module = network(GROUPS["D3"], kind, relaxed=relaxed, dtype=dtype)
    if relaxed:
        disturb(module)
    plain = module.dense()
    assert {type(layer) for layer in plain} <= {nn.Linear, nn.ELU}
    x = random(2, 5, module.in_rep.dim, dtype=dtype)
    assert_close(plain(x), module(x), 1e-6 if dtype == torch.float32 else 1e-13)
    plain[0].weight.data.zero_()  # nothing is shared
    assert_close(module.dense()(x), module(x), 1e-6 if dtype == torch.float32 else 1e-13)


def test_events_of_several_dimensions():
    group = GROUPS["K4"]
    agents = (polar(group) * 4).unflatten((4, 3))
    module = EquivariantMLP(agents, agents, (8,), dtype=torch.float64)
    assert_exact(module, agents, agents)
    x = random(2, 5, 4, 3)
    assert_close(module.dense()(x), module(x), 1e-13)
    assert module(random(4, 3)).shape == (4, 3)
    with pytest.raises(
        ValueError, match=r"expected last dimensions of \(4, 3\), got a tensor of shape \(2, 12\)"
    ):
        module(random(2, 12))


def disturb(module) -> None:
    with torch.no_grad():
        for name, parameter in module.named_parameters():
            if "free" in name:
                parameter.normal_(std=0.1)


@by_kind
def test_relaxed_networks_begin_exact_and_may_leave(kind):
    group = GROUPS["D3"]
    exact = network(group, kind, dtype=torch.float64)
    module = network(group, kind, relaxed=True, dtype=torch.float64)
    module.load_state_dict(exact.state_dict(), strict=False)
    x = random(7, module.in_rep.dim)
    assert_close(module(x), exact(x), 1e-13)
    assert module.relaxation() == exact.relaxation() == 0.0
    disturb(module)
    free = [p for name, p in module.named_parameters() if "free" in name]
    assert len(free) == 2 * (1 if kind is EquivariantLinear else 3)
    assert_close(module.relaxation(), sum(p.square().sum() for p in free))
    module.relaxation().backward()
    assert all(torch.equal(p.grad, 2 * p) for p in free)
    with pytest.raises(AssertionError):
        assert_exact(module, module.in_rep, module.out_rep)


def test_relaxed_networks_can_break_a_tie():
    """A state that is its own image: an exactly equivariant mean cannot leave zero, a relaxed one can."""
    sign = pseudoscalar(GROUPS["reflect-y"])
    for relaxed in (False, True):
        module = EquivariantMLP(sign, sign, (8,), relaxed=relaxed)
        optimizer = torch.optim.Adam(module.parameters(), lr=0.05)
        for _ in range(40):
            optimizer.zero_grad()
            (module(torch.zeros(1, 1)) - 1).square().sum().backward()
            optimizer.step()
        assert (module(torch.zeros(1, 1)).abs() > 0.5) == relaxed


# --- ordinary modules


@by_kind
@pytest.mark.parametrize("relaxed", [False, True])
def test_saved_copied_and_pickled(kind, relaxed):
    module = network(GROUPS["D3"], kind, relaxed=relaxed)
    torch.manual_seed(1)
    target = 2 if kind is InvariantMLP else module.out_rep
    other = kind(module.in_rep, target, *([] if kind is EquivariantLinear else [(12, 18)]))
    x = random(3, module.in_rep.dim, dtype=torch.float32)
    assert not torch.allclose(other(x), module(x))
    other.load_state_dict(module.state_dict(), strict=not relaxed)
    for same in (other, copy.deepcopy(module), pickle.loads(pickle.dumps(module))):
        assert_close(same(x), module(x), 1e-6 if relaxed else 0.0)
    assert set(module.state_dict()) == {name for name, _ in module.named_parameters()}


@by_kind
def test_casting_back_loses_no_precision(kind):
    """The change of basis is exact in every precision, though parameters have been rounded in between."""
    module = network(GROUPS["D3"], kind).bfloat16().double()
    assert_exact(module, module.in_rep, module.out_rep)


@by_kind
def test_functional_parameters_and_vmap(kind):
    modules = [network(GROUPS["D3"], kind, dtype=torch.float64) for _ in range(3)]
    for module in modules[1:]:
        for parameter in module.parameters():
            nn.init.normal_(parameter)
    params, buffers = torch.func.stack_module_state(modules)
    assert not buffers
    x = random(4, modules[0].in_rep.dim)
    call = lambda p: torch.func.functional_call(modules[0], p, (x,))  # noqa: E731
    expected = torch.stack([module(x) for module in modules])
    assert_close(torch.vmap(call)(params), expected, 1e-13)


@by_kind
@pytest.mark.parametrize("relaxed", [False, True])
def test_gradients(kind, relaxed):
    module = network(GROUPS["C3"], kind, relaxed=relaxed, dtype=torch.float64)
    x = random(2, module.in_rep.dim).requires_grad_()
    names, values = zip(*module.named_parameters(), strict=True)

    def call(x, *values):
        return torch.func.functional_call(module, dict(zip(names, values, strict=True)), (x,))

    assert torch.autograd.gradcheck(call, (x, *values), fast_mode=True)


@by_kind
@pytest.mark.parametrize("relaxed", [False, True])
def test_compiles_to_one_graph(kind, relaxed):
    torch.compiler.reset()
    module = network(GROUPS["D3"], kind, relaxed=relaxed, dtype=torch.float64)
    compiled = torch.compile(module, fullgraph=True, backend="aot_eager")
    x = random(6, module.in_rep.dim)
    assert_close(compiled(x), module(x), 1e-13)
    compiled(x).sum().backward()
    assert all(parameter.grad is not None for parameter in module.parameters())
    assert_exact(compiled, module.in_rep, module.out_rep)


@by_kind
def test_exports_with_a_free_batch(kind):
    module = network(GROUPS["D3"], kind, dtype=torch.float64)
    x = random(4, module.in_rep.dim)
    for exported in (module, module.dense()):
        program = torch.export.export(exported, (x,), dynamic_shapes=({0: torch.export.Dim("batch")},))
        assert_exact(program.module(), module.in_rep, module.out_rep)
        assert program.module()(random(9, module.in_rep.dim)).shape == (9, module.out_rep.dim)


@by_kind
def test_onnx_has_equal_outputs(kind, tmp_path):
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    module = network(GROUPS["D3"], kind)
    x = random(4, module.in_rep.dim, dtype=torch.float32)
    path = tmp_path / "policy.onnx"
    torch.onnx.export(module.dense(), (x,), path, dynamo=True, verbose=False, external_data=False)
    session = runtime.InferenceSession(str(path))
    (y,) = session.run(None, {session.get_inputs()[0].name: x.numpy()})
    assert_close(torch.from_numpy(y), module(x).detach(), 1e-5)


def test_empty_batches_and_single_rows():
    module = network(GROUPS["D3"])
    assert module(torch.zeros(0, module.in_rep.dim)).shape == (0, module.out_rep.dim)
    x = torch.randn(3, module.in_rep.dim)
    assert_close(torch.stack([module(row) for row in x]), module(x), 1e-6)


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
    assert_equivariant(critic.double(), state + action, inputs=random(4, 12))
    assert math.isclose(critic.linears[1].weight.numel(), 16 * 16 / 4)
