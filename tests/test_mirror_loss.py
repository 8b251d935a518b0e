"""MirrorLoss against Eq. (symm-loss) worked out by hand, and against TorchRL's contracts for losses."""

import copy
import io
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss, SACLoss

from tests.networks import (
    ACTION_DIM,
    OBSERVATION_DIM,
    SYMMETRIC,
    CatInputs,
    add_transitions,
    assert_unchanged,
    gradients,
    make_actor,
    make_batch,
    make_critic,
    make_symmetry,
)
from torchrl_sym import MirrorLoss, PointGroup, Symmetry
from torchrl_sym.representations import pseudoscalar, scalar


def linear_policy(weight, bias=None, *, action="action", observation="observation"):
    """A deterministic (TD3-like) policy a = W s + b."""
    net = nn.Linear(weight.shape[1], weight.shape[0], bias=bias is not None, dtype=torch.float64)
    net.weight.data.copy_(weight)
    if bias is not None:
        net.bias.data.copy_(bias)
    return TensorDictModule(net, [observation], [action])


def random_weight(seed=5):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(ACTION_DIM, OBSERVATION_DIM, generator=generator, dtype=torch.float64)


def maps(group):
    """The matrices L_g and K_g."""
    symmetry = make_symmetry(group)
    return symmetry["observation"].matrices, symmetry["action"].matrices


def mirror_error_by_hand(weight, states, group):
    """|| K_g W s - W L_g s ||^2 for every element and state, ``(N, B)``."""
    left, act = maps(group)
    residual = states @ (act @ weight).mT - states @ (weight @ left).mT  # (N, B, A)
    return residual.pow(2).sum(-1)


# Two-dimensional example: s = (p, q) with p invariant and q odd, a odd, pi(s) = u p + v q + c. Then
# K pi(s) = -(u p + v q + c), pi(L s) = u p - v q + c, and their difference is 2 (u p + c).
STATES = [(1.0, 2.0), (-2.0, 1.0), (0.5, -1.0)]
U, V, C = 0.5, 0.25, -1.0


def example(stop_gradient=True):
    group = PointGroup.reflection("x")
    odd = pseudoscalar(group)
    symmetry = Symmetry(group, {"observation": scalar(group) + odd, "action": odd})
    policy = linear_policy(torch.tensor([[U, V]]), torch.tensor([C]))
    loss = MirrorLoss(policy, symmetry=symmetry, stop_gradient=stop_gradient)
    batch = TensorDict(observation=torch.tensor(STATES, dtype=torch.float64), batch_size=[3])
    return loss, batch, policy


def test_value_by_hand():
    loss, batch, _ = example()
    expected = sum((2 * (U * p + C)) ** 2 for p, _ in STATES) / 3
    assert expected == pytest.approx((1.0 + 16.0 + 2.25) / 3)
    assert loss(batch)["loss_mirror"].item() == pytest.approx(expected, abs=1e-14)


@pytest.mark.parametrize("stop_gradient", [True, False])
def test_gradient_by_hand(stop_gradient):
    loss, batch, policy = example(stop_gradient)
    # label: 2 (pi(Ls) - label) grad pi(Ls);  no label: the gradient of 4 (u p + c)^2
    u = [(4 if stop_gradient else 8) * (U * p + C) * p for p, _ in STATES]
    v = [(4 * (U * p + C) * -q if stop_gradient else 0.0) for p, q in STATES]
    c = [(4 if stop_gradient else 8) * (U * p + C) for p, _ in STATES]
    expected = torch.tensor([sum(u), sum(v), sum(c)], dtype=torch.float64) / 3
    torch.testing.assert_close(gradients(loss, batch, [policy]), expected)


@pytest.mark.parametrize("group", SYMMETRIC)
def test_value_is_the_sum_over_the_group(group):
    batch, weight = make_batch(), random_weight()
    loss = MirrorLoss(linear_policy(weight), symmetry=make_symmetry(group))
    expected = mirror_error_by_hand(weight, batch["observation"], group).sum(0).mean()
    assert expected > 0.1
    torch.testing.assert_close(loss(batch)["loss_mirror"], expected)


@pytest.mark.parametrize("stop_gradient", [True, False])
@pytest.mark.parametrize("group", SYMMETRIC)
def test_gradient_flows_only_through_the_mirrored_state(group, stop_gradient):
    batch, weight = make_batch(), random_weight()
    policy = linear_policy(weight)
    loss = MirrorLoss(policy, symmetry=make_symmetry(group), stop_gradient=stop_gradient)
    states = batch["observation"]
    expected = torch.zeros_like(weight)
    for left, act in zip(*maps(group), strict=True):
        residual = states @ (weight @ left).mT - states @ (act @ weight).mT  # pi(L_g s) - K_g pi(s)
        expected += 2 * residual.mT @ (states @ left.mT) / len(states)
        if not stop_gradient:
            expected -= 2 * (residual @ act).mT @ states / len(states)
    torch.testing.assert_close(gradients(loss, batch, [policy]), expected.flatten())


@pytest.mark.parametrize("group", ["C1", *SYMMETRIC])
def test_equivariant_policy_has_no_loss(group):
    weight = random_weight()
    left, act = maps(group)
    equivariant = (act.mT @ weight @ left).mean(0)  # mean of K_g^-1 W L_g
    assert group == "C1" or not torch.allclose(equivariant, weight, atol=0.1)
    for network in (linear_policy(equivariant), equivariant_gaussian(equivariant)):
        loss = MirrorLoss(network, symmetry=make_symmetry(group), stop_gradient=False)
        assert loss(make_batch())["loss_mirror"].item() < 1e-12
        assert gradients(loss, make_batch(), [network]).abs().max() < 1e-12


def equivariant_gaussian(weight):
    """A Gaussian actor with mean W s and constant scale."""
    linear = nn.Linear(OBSERVATION_DIM, 2 * ACTION_DIM, bias=False, dtype=torch.float64)
    linear.weight.data.copy_(torch.cat([weight, torch.zeros_like(weight)]))
    actor = make_actor(IndependentNormal)
    actor[0].module = nn.Sequential(linear, NormalParamExtractor())
    return actor


@pytest.mark.parametrize("distribution", [IndependentNormal, TanhNormal])
def test_trivial_group_costs_nothing_and_backward_works(distribution):
    actor = make_actor(distribution)
    loss = MirrorLoss(actor, symmetry=make_symmetry("C1"), per_element=True)
    out = loss(make_batch())
    out["loss_mirror"].backward()
    assert out["loss_mirror"].item() == 0 and torch.equal(out["mirror_error"], torch.zeros(1).double())
    assert all(p.grad is not None and not p.grad.any() for p in actor.parameters())


@pytest.mark.parametrize("distribution", [IndependentNormal, TanhNormal])
def test_compares_the_deterministic_action(distribution):
    symmetry, batch, actor = make_symmetry("C2"), make_batch(), make_actor(distribution)

    def pi(observation):
        loc = actor[0].module(observation)[0]
        return 2 * loc.tanh() if distribution is TanhNormal else loc  # the box is [-2, 2]

    state = batch["observation"]
    residual = symmetry["action"](pi(state), 1) - pi(symmetry["observation"](state, 1))
    value = MirrorLoss(actor, symmetry=symmetry)(batch)["loss_mirror"]
    torch.testing.assert_close(value, residual.pow(2).sum(-1).mean())


def test_critic_must_be_invariant():
    symmetry, batch, critic = make_symmetry("K4"), make_batch(), make_critic()
    value = critic.module(symmetry["observation"].orbit(batch["observation"]))
    expected = (value - value[0]).pow(2).sum((0, -1)).mean()
    assert expected > 1e-2
    loss = MirrorLoss(critic, symmetry=symmetry)
    torch.testing.assert_close(loss(batch)["loss_mirror"], expected)
    assert gradients(loss, batch, [critic]).abs().max() > 1e-3


def test_invariant_critic_has_no_loss():
    norm = ValueOperator(nn.Module(), in_keys=["observation"])
    norm.module.forward = lambda s: s.pow(2).sum(-1, keepdim=True)
    loss = MirrorLoss(norm, symmetry=make_symmetry("D3"), functional=False)
    assert loss(make_batch())["loss_mirror"].item() < 1e-12


@pytest.mark.parametrize("group", ["C2", "D3"])
def test_weight_of_implementations_that_average(group):
    """rsl_rl: mean over copies, rows and action entries; w_rsl = w (N - 1) action_dim."""
    symmetry, batch, actor = make_symmetry(group), make_batch(), make_actor()
    copies = symmetry["observation"].orbit(batch["observation"])
    mean = actor[0].module(copies)[0]
    label = symmetry["action"].orbit(mean[0]).detach()
    weight = 0.7 * (symmetry.group.order - 1) * ACTION_DIM
    rsl = weight * nn.functional.mse_loss(mean[1:], label[1:])
    rsl_gradient = torch.cat([g.flatten() for g in torch.autograd.grad(rsl, actor.parameters())])
    loss = MirrorLoss(actor, symmetry=symmetry, coeff=0.7)
    torch.testing.assert_close(loss(batch)["loss_mirror"], rsl)
    torch.testing.assert_close(gradients(loss, batch, [actor]), rsl_gradient)


def test_adds_its_gradient_to_clip_ppo():
    actor, critic, batch = make_actor(), make_critic(), make_batch()
    ppo, mirror = ClipPPOLoss(actor, critic), MirrorLoss(actor, symmetry=make_symmetry(), coeff=0.5)
    loss = ppo(batch), mirror(batch)
    both = sum(v for td in loss for k, v in td.items() if k.startswith("loss_"))
    both = torch.autograd.grad(both, list(actor.parameters()))
    expected = gradients(ppo, batch, [actor]) + gradients(mirror, batch, [actor])
    torch.testing.assert_close(torch.cat([g.flatten() for g in both]), expected)


@pytest.mark.filterwarnings("ignore:No target network updater")
def test_adds_its_gradient_to_sac():
    actor, batch = make_actor(TanhNormal), add_transitions(make_batch(3, 4, bound=1.9))
    q = nn.Sequential(nn.Linear(OBSERVATION_DIM + ACTION_DIM, 8), nn.Tanh(), nn.Linear(8, 1)).double()
    critic = TensorDictModule(
        CatInputs(q), in_keys=["observation", "action"], out_keys=["state_action_value"]
    )
    sac = SACLoss(actor, critic, target_entropy=-3.0)
    sac.make_value_estimator()
    mirror = MirrorLoss(actor, symmetry=make_symmetry("K4"))
    torch.manual_seed(0)
    alone = gradients(sac, batch, [actor], only=["loss_actor"])
    torch.manual_seed(0)
    both = sac(batch)["loss_actor"] + mirror(batch)["loss_mirror"]
    both = torch.autograd.grad(both, list(actor.parameters()))
    expected = alone + gradients(mirror, batch, [actor])
    torch.testing.assert_close(torch.cat([g.flatten() for g in both]), expected)


def test_is_a_metric_under_no_grad():
    loss, batch = MirrorLoss(make_actor(), symmetry=make_symmetry("K4")), make_batch()
    with torch.no_grad():
        value = loss(batch)["loss_mirror"]
    assert not value.requires_grad
    assert torch.equal(value, loss(batch)["loss_mirror"].detach())


@pytest.mark.parametrize("size", [(12,), (4, 3)])
def test_error_per_element(size):
    batch, weight = make_batch(*size), random_weight()
    loss = MirrorLoss(linear_policy(weight), symmetry=make_symmetry("D3"), coeff=3.0, per_element=True)
    error = mirror_error_by_hand(weight, batch["observation"].flatten(0, -2), "D3").mean(1)
    out = loss(batch)
    torch.testing.assert_close(out["mirror_error"], error)
    assert out["mirror_error"][0] == 0 and not out["mirror_error"].requires_grad
    torch.testing.assert_close(out["loss_mirror"], 3.0 * error.sum())
    assert loss.out_keys == ["loss_mirror", "mirror_error"]


@pytest.mark.parametrize("size", [(12,), (4, 3), (1,)])
def test_reductions(size):
    batch, weight = make_batch(*size), random_weight()
    rows = mirror_error_by_hand(weight, batch["observation"].flatten(0, -2), "K4").sum(0)
    expected = {"none": rows.reshape(size), "mean": rows.mean(), "sum": rows.sum()}
    for reduction, value in expected.items():
        loss = MirrorLoss(linear_policy(weight), symmetry=make_symmetry("K4"), reduction=reduction)
        torch.testing.assert_close(loss(batch)["loss_mirror"], value)


def test_mask_drops_rows():
    batch, weight = make_batch(4, 3), random_weight()
    mask = torch.arange(12).reshape(4, 3, 1) % 3 > 0
    batch[~mask.squeeze(-1)] = float("nan") * batch[~mask.squeeze(-1)]
    rows = batch["observation"][mask.squeeze(-1)]
    loss = MirrorLoss(linear_policy(weight), symmetry=make_symmetry("C2"))
    value = loss(batch.set(("collector", "mask"), mask))["loss_mirror"]
    torch.testing.assert_close(value, mirror_error_by_hand(weight, rows, "C2").sum(0).mean())


def test_functional_or_not_is_the_same():
    actor, batch, symmetry = make_actor(), make_batch(), make_symmetry("K4")
    losses = [MirrorLoss(actor, symmetry=symmetry, functional=f) for f in (True, False)]
    assert torch.equal(*(loss(batch)["loss_mirror"] for loss in losses))
    assert torch.equal(*(gradients(loss, batch, [actor]) for loss in losses))


NESTED = ("agent", "observation"), ("agent", "action")


@pytest.mark.parametrize("kind", ["gaussian", "deterministic"])
@pytest.mark.parametrize("set_keys", [True, False])
def test_nested_keys(kind, set_keys):
    observation, action = NESTED
    weight, batch = random_weight(), make_batch()
    make = {
        "gaussian": lambda o, a: make_actor(observation=o, action=a),
        "deterministic": lambda o, a: linear_policy(weight, observation=o, action=a),
    }[kind]
    plain = MirrorLoss(make("observation", "action"), symmetry=make_symmetry("K4"))
    nested = MirrorLoss(make(*NESTED), symmetry=make_symmetry("K4", *NESTED))
    if set_keys:
        nested.set_keys(action=action)
    assert nested.in_keys == [observation]
    moved = batch.copy().rename_key_("observation", observation)
    assert torch.equal(nested(moved)["loss_mirror"], plain(batch)["loss_mirror"])


def test_value_key_can_be_set():
    symmetry, batch = make_symmetry("K4"), make_batch()
    loss = MirrorLoss(make_critic(value=("agent", "v")), symmetry=symmetry)
    loss.set_keys(value=("agent", "v"))
    expected = MirrorLoss(make_critic(), symmetry=symmetry)(batch)["loss_mirror"]
    assert torch.equal(loss(batch)["loss_mirror"], expected)


@pytest.mark.parametrize("size", [(12,), (4, 3)])
@pytest.mark.parametrize("reduction", ["mean", "none"])
def test_keywords_instead_of_a_tensordict(size, reduction):
    batch = make_batch(*size)
    loss = MirrorLoss(make_actor(), symmetry=make_symmetry("K4"), per_element=True, reduction=reduction)
    assert loss.in_keys == ["observation"]
    value, error = loss(observation=batch["observation"])
    expected = loss(batch)
    assert torch.equal(value, expected["loss_mirror"]) and torch.equal(error, expected["mirror_error"])


def test_coefficient_is_schedulable_and_saved():
    actor, batch, symmetry = make_actor(), make_batch(), make_symmetry()
    loss = MirrorLoss(actor, symmetry=symmetry)
    before = loss(batch)["loss_mirror"]
    loss.coeff = 0.25
    torch.testing.assert_close(loss(batch)["loss_mirror"], 0.25 * before)
    file = io.BytesIO()
    torch.save(loss.state_dict(), file)
    file.seek(0)
    other = MirrorLoss(make_actor(seed=9), symmetry=symmetry, coeff=8.0)
    other.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(other(batch)["loss_mirror"], loss(batch)["loss_mirror"])


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_can_be_copied(duplicate):
    loss, batch = MirrorLoss(make_actor(), symmetry=make_symmetry("D3")), make_batch()
    assert torch.equal(duplicate(loss)(batch)["loss_mirror"], loss(batch)["loss_mirror"])


@pytest.mark.parametrize("stop_gradient", [True, False])
@pytest.mark.parametrize("network", [make_actor, make_critic, lambda: linear_policy(random_weight())])
def test_input_is_not_modified(network, stop_gradient):
    loss = MirrorLoss(network(), symmetry=make_symmetry("K4"), stop_gradient=stop_gradient)
    assert_unchanged(loss, make_batch())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_keeps_the_precision(dtype):
    loss = MirrorLoss(make_actor(dtype=dtype), symmetry=make_symmetry("D3"), per_element=True)
    out = loss(make_batch(dtype=dtype))
    assert out["loss_mirror"].dtype == out["mirror_error"].dtype == dtype


def test_compiles_without_graph_breaks():
    actor, batch = make_actor(), make_batch()
    loss = MirrorLoss(actor, symmetry=make_symmetry("K4"))
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(batch)["loss_mirror"], loss(batch)["loss_mirror"])
    torch.testing.assert_close(gradients(compiled, batch, [actor]), gradients(loss, batch, [actor]))


def test_unknown_observation_is_an_error():
    with pytest.raises(KeyError, match=r"reads \['velocity'\], which this symmetry does not transform"):
        MirrorLoss(make_actor(observation="velocity"), symmetry=make_symmetry())


def test_undeclared_action_is_an_error():
    group = PointGroup.reflection("x")
    symmetry = Symmetry(group, {"observation": pseudoscalar(group) * OBSERVATION_DIM})
    for network in (make_actor(), linear_policy(random_weight())):
        with pytest.raises(KeyError, match="no representation for 'action'"):
            MirrorLoss(network, symmetry=symmetry)


def test_network_without_a_known_output_is_an_error():
    torque = linear_policy(random_weight(), action="torque")
    with pytest.raises(KeyError, match=r"\['torque'\], neither the action 'action' nor the value"):
        MirrorLoss(torque, symmetry=make_symmetry())(make_batch())


def test_observation_of_another_size_is_an_error():
    loss = MirrorLoss(make_actor(), symmetry=make_symmetry())
    with pytest.raises(ValueError, match="expected event dimensions"):
        loss(TensorDict(observation=torch.zeros(2, 5), batch_size=[2]))
