"""Augmentation of equivariant networks changes nothing; a dense actor shows that it could."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss, SACLoss

from tests.equivariant import assert_same_losses, by_group
from tests.point_groups import GROUPS, assert_close, random
from torchrl_sym import MirrorLoss, SymmetricClipPPOLoss, Symmetry
from torchrl_sym.modules import (
    EquivariantLayerNorm,
    EquivariantLinear,
    EquivariantMLP,
    InvariantMLP,
    TiedScale,
)
from torchrl_sym.representations import axial, polar, regular
from torchrl_sym.testing import assert_equivariant


def with_tied_scale(state, action, group):
    return nn.Sequential(EquivariantMLP(state, action, (2 * group.order,) * 2), TiedScale(action, 0.5))


def with_scale_of_the_state(state, action, group):
    network = EquivariantMLP(state, action + action.absolute(), (2 * group.order,))
    return nn.Sequential(network, NormalParamExtractor())


def with_memoryless_norm(state, action, group):
    hidden = regular(group, 3)
    first, last = EquivariantLinear(state, hidden), EquivariantLinear(hidden, action)
    return nn.Sequential(first, EquivariantLayerNorm(hidden), nn.Tanh(), last, TiedScale(action))


def dense(state, action, group):
    return nn.Sequential(MLP(state.dim, action.dim, num_cells=[2 * group.order]), TiedScale(action))


POLICIES = [with_tied_scale, with_scale_of_the_state, with_memoryless_norm]


def losses(make, group):
    torch.manual_seed(0)
    state, action = polar(group) + axial(group), regular(group)
    if make is not with_scale_of_the_state:
        action = action + polar(group)  # whose entries mix under turns: they have one scale
    actor = ProbabilisticActor(
        TensorDictModule(make(state, action, group), ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    critic = InvariantMLP(state, 1, (2 * group.order,))
    critic = TensorDictModule(critic, ["observation"], ["state_value"])
    symmetry = Symmetry(group, {"observation": state, "action": action})
    batch = TensorDict(
        observation=torch.randn(24, state.dim),
        advantage=torch.randn(24, 1),
        value_target=torch.randn(24, 1),
        batch_size=[24],
    )
    with torch.no_grad():
        actor(batch)
        batch["action_log_prob"] += 0.2 * torch.randn(24)  # of an older policy: some ratios are clipped
    batch = batch.select("observation", "action", "action_log_prob", "advantage", "value_target")
    augmented = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry, mirror_coeff=1.0)
    return augmented, ClipPPOLoss(actor, critic), batch


@by_group
@pytest.mark.parametrize("make", POLICIES, ids=lambda make: make.__name__)
def test_copies_change_nothing(make, group):
    augmented, plain, batch = losses(make, group)
    assert_same_losses(augmented, plain, batch)
    out = augmented(batch)
    assert_close(out["kl_approx_sym"], out["kl_approx"].expand(group.order), 1e-5)


def test_copies_change_the_loss_of_a_dense_actor():
    with pytest.raises(AssertionError):
        assert_same_losses(*losses(dense, GROUPS["K4"]))


class StateAction(nn.Module):
    def __init__(self, rep):
        super().__init__()
        self.net = InvariantMLP(rep, 1, (2 * rep.group.order,))

    def forward(self, observation, action):
        return self.net(torch.cat([observation, action], -1))


def test_an_ensemble_of_critics_in_sac_is_invariant():
    """TorchRL draws the parameters of an ensemble anew and keeps them apart from the module."""
    torch.manual_seed(0)
    group = GROUPS["D3"]
    state, action = polar(group), axial(group)
    actor = ProbabilisticActor(
        TensorDictModule(with_tied_scale(state, action, group), ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(StateAction(state + action), in_keys=["observation", "action"])
    loss = SACLoss(actor, critic, num_qvalue_nets=2, target_entropy=-3.0)
    batch = TensorDict(observation=torch.randn(5, 3), action=torch.randn(5, 3), batch_size=[5])
    one, other = (each.flatten_keys().values() for each in loss.qvalue_network_params.unbind(0))
    assert not any(torch.equal(a, b) for a, b in zip(one, other, strict=True) if a.numel() > 1)
    symmetry = Symmetry(group, {"observation": state, "action": action})
    mirror = MirrorLoss.of(loss, "qvalue_network", symmetry=symmetry)
    assert mirror(batch)["loss_mirror"] < 1e-10
    for parameter in loss.qvalue_network_params.parameters():
        nn.init.normal_(parameter)
    assert mirror(batch)["loss_mirror"] < 1e-8


# --- tied numbers


@by_group
def test_layer_norm_commutes_and_is_pytorchs_on_permutations(group):
    hidden = regular(group, 3)
    norm = EquivariantLayerNorm(hidden, dtype=torch.float64)
    assert norm.weight.numel() == norm.bias.numel() == 3
    x = 5 + random(6, hidden.dim)
    plain = nn.LayerNorm(hidden.dim, dtype=torch.float64)
    with torch.no_grad():
        assert_close(norm(x), plain(x))
        nn.init.normal_(norm.weight), nn.init.normal_(norm.bias)
        plain.weight.copy_(norm.weight.repeat(group.order))
        plain.bias.copy_(norm.bias.repeat(group.order))
        assert_close(norm(x), plain(x))


@by_group
def test_layer_norm_commutes_with_every_kind_of_entry(group):
    rep = polar(group) + regular(group, 2) + axial(group)
    norm = EquivariantLayerNorm(rep, dtype=torch.float64)
    nn.init.normal_(norm.weight), nn.init.normal_(norm.bias)
    x = 3 + random(6, rep.dim)
    assert_equivariant(norm, rep, rep, inputs=x, tolerance=1e-12)
    assert norm.bias.numel() >= 2 and norm.bias.grad is None
    norm(x).square().sum().backward()
    assert norm.bias.grad.abs().min() > 0 and norm.weight.grad.abs().min() > 0


@by_group
def test_scales_are_one_number_for_each_component(group):
    action = polar(group) + regular(group, 2)
    scale = TiedScale(action, 0.3, dtype=torch.float64)
    assert scale.log_scale.numel() == int(action.components.max()) + 1
    loc = random(4, action.dim)
    same, found = scale(loc)
    assert same is loc
    assert_close(found, torch.full_like(loc, 0.3))
    nn.init.normal_(scale.log_scale)
    covariance = scale(loc)[1][0].square().diag()
    for rho in action.matrices:  # the covariance of an image is the image of the covariance
        assert_close(rho @ covariance @ rho.T, covariance)
    assert scale(torch.zeros(2, 3, action.dim, dtype=torch.float64))[1].shape == (2, 3, action.dim)
