"""Equivariant networks for tests, and how their equivariance is measured."""

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.objectives import LossModule

from tests.point_groups import GROUPS, random
from torchrl_sym import PointGroup, Representation
from torchrl_sym.modules import EquivariantLinear, EquivariantMLP, InvariantMLP
from torchrl_sym.representations import axial, invariant, polar, pseudoscalar, regular, scalar

PAPER = ["reflect-y", "K4", "C3", "C4", "D3", "D4"]
TOLERANCE = {torch.float32: 1e-6, torch.float64: 1e-12}
KINDS = [EquivariantLinear, EquivariantMLP, InvariantMLP]

by_dtype = pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
by_group = pytest.mark.parametrize("group", [GROUPS[name] for name in PAPER], ids=PAPER)
by_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
by_relaxed = pytest.mark.parametrize("relaxed", [False, True], ids=["exact", "relaxed"])


def assert_exact(module, in_rep, out_rep=None, dtype=torch.float64, tolerance=None) -> None:
    """Equivariant to rounding, in events of any shape, and not just zero."""
    x = random(16, *in_rep.event_shape, dtype=dtype)
    y = module(x)
    out_rep = invariant(in_rep.group, y.shape[-1]) if out_rep is None else out_rep
    assert y.dtype == dtype and y.abs().max() > 1e-3
    for g in range(in_rep.group.order):
        error = (module(in_rep(x, g)) - out_rep(y, g)).abs().max() / y.abs().max().clamp(min=1.0)
        assert error <= (TOLERANCE[dtype] if tolerance is None else tolerance)


def entries(group: PointGroup) -> Representation:
    """A little of everything, dense blocks included."""
    return polar(group) * 2 + axial(group) + pseudoscalar(group) + scalar(group) + regular(group, 2)


def network(group: PointGroup, kind=EquivariantMLP, **kwargs) -> torch.nn.Module:
    torch.manual_seed(0)
    rep = entries(group)
    target = 2 if kind is InvariantMLP else polar(group) + axial(group) + scalar(group)
    sizes = [] if kind is EquivariantLinear else [(2 * group.order, 3 * group.order)]
    return kind(rep, target, *sizes, **kwargs)


def disturb(module) -> None:
    """Give the free parts of relaxed layers something."""
    with torch.no_grad():
        for name, parameter in module.named_parameters():
            if "free" in name:
                parameter.normal_(std=0.1)


def assert_same_losses(loss: LossModule, plain: LossModule, batch: TensorDictBase) -> None:
    """Copies change neither a loss nor a gradient."""
    found = []
    for each in (loss, plain):
        each.zero_grad()
        out = each(batch)
        terms = [out[key] for key in ("loss_objective", "loss_critic", "loss_entropy")]
        sum(terms).backward()
        found.append(([term.detach() for term in terms], [p.grad.clone() for p in each.parameters()]))
    assert_near(found[0][0], found[1][0])
    assert_near(found[0][1], found[1][1])
    assert any(grad.abs().max() > 1e-3 for grad in found[0][1])
    assert loss(batch)["loss_mirror"] < 1e-10


def assert_near(some, others) -> None:
    for one, other in zip(some, others, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
