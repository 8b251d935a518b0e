"""Equivariant layers and networks as modules: dense, relaxed, saved, differentiated, compiled, exported."""

import copy
import pickle
import re
from pathlib import Path

import pytest
import torch
from torch import nn

from tests.equivariant import (
    assert_exact,
    by_dtype,
    by_kind,
    by_relaxed,
    disturb,
    network,
)
from tests.point_groups import GROUPS, assert_close, random
from torchrl_sym.modules import EquivariantLinear, EquivariantMLP, InvariantMLP
from torchrl_sym.representations import polar, pseudoscalar

# --- dense(), relaxation()


@by_dtype
@by_kind
@by_relaxed
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
@by_relaxed
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
@by_relaxed
def test_gradients(kind, relaxed):
    module = network(GROUPS["C3"], kind, relaxed=relaxed, dtype=torch.float64)
    x = random(2, module.in_rep.dim).requires_grad_()
    names, values = zip(*module.named_parameters(), strict=True)

    def call(x, *values):
        return torch.func.functional_call(module, dict(zip(names, values, strict=True)), (x,))

    assert torch.autograd.gradcheck(call, (x, *values), fast_mode=True)


def test_compiles_to_one_graph():
    """With dense blocks and several sizes of irreducible representations; forward and backward."""
    torch.compiler.reset()
    rep = polar(GROUPS["D3"])
    module = EquivariantMLP(rep, rep, (6,), dtype=torch.float64)
    compiled = torch.compile(module, fullgraph=True, backend="aot_eager")
    x = random(16, 3)
    assert_close(compiled(x), module(x), 1e-13)
    compiled(x).sum().backward()
    assert all(parameter.grad is not None for parameter in module.parameters())
    assert_exact(compiled, rep, rep)


def test_exports_with_a_free_batch():
    module = network(GROUPS["D3"], dtype=torch.float64)
    x = random(4, module.in_rep.dim)
    for exported in (module, module.dense()):
        program = torch.export.export(exported, (x,), dynamic_shapes=({0: torch.export.Dim("batch")},))
        assert_exact(program.module(), module.in_rep, module.out_rep)
        assert program.module()(random(9, module.in_rep.dim)).shape == (9, module.out_rep.dim)


def test_onnx_has_equal_outputs(tmp_path):
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    module = network(GROUPS["D3"])
    x = random(4, module.in_rep.dim, dtype=torch.float32)
    path = tmp_path / "policy.onnx"
    for exported in (module, module.dense()):
        torch.onnx.export(exported, (x,), path, dynamo=True, verbose=False, external_data=False)
        session = runtime.InferenceSession(str(path))
        (y,) = session.run(None, {session.get_inputs()[0].name: x.numpy()})
        assert_close(torch.from_numpy(y), module(x).detach(), 1e-5)


GOLDEN = {
    "K4": [-0.885413574, -0.003618273, -0.546345744, -0.004698826, -1.343286585, -0.372889311, 0.423291412],
    "C3": [0.542168155, 1.342062074, -0.36480002, 1.047356531, 1.783224154, 0.10924558, 0.58329118],
    "D3": [-0.057504904, -3.0802687, -1.12549269, -6.665297507, 0.342549214, -0.008463375, 0.147854464],
}


@pytest.mark.parametrize("group", GOLDEN)
def test_saved_parameters_mean_the_same_on_every_machine(group):
    """And in every version: what a basis of an irreducible representation is must not change."""
    module = network(GROUPS[group], dtype=torch.float64)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.copy_(torch.linspace(-0.3, 0.5, parameter.numel()))
        y = module(torch.linspace(-1, 1, module.in_rep.dim, dtype=torch.float64))
    assert_close(y, torch.tensor(GOLDEN[group], dtype=torch.float64), 1e-6)


def test_empty_batches_and_single_rows():
    module = network(GROUPS["D3"])
    assert module(torch.zeros(0, module.in_rep.dim)).shape == (0, module.out_rep.dim)
    x = torch.randn(3, module.in_rep.dim)
    assert_close(torch.stack([module(row) for row in x]), module(x), 1e-6)


def test_code_in_the_guide():
    guide = (Path(__file__).parents[1] / "docs" / "networks.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", guide, flags=re.DOTALL)
    assert len(blocks) == 4
    exec(compile("\n".join(blocks), "networks.md", "exec"), {})
