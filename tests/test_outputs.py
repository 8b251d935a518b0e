"""What a mirror loss compares, and what it refuses to; without waiting for a device."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution, TensorDictModule
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.data import Categorical, OneHot
from torchrl.modules import (
    DistributionalQValueActor,
    IndependentNormal,
    MaskedOneHotCategorical,
    OneHotCategorical,
    ProbabilisticActor,
    QValueActor,
)

from tests.networks import (
    ACTION_DIM,
    OBSERVATION_DIM,
    gradients,
    make_actor,
    make_batch,
    make_critic,
    make_symmetry,
)
from torchrl_sym import MirrorLoss, PointGroup, Symmetry
from torchrl_sym.mirror_loss import mirror_error
from torchrl_sym.representations import permutation, pseudoscalar

GROUP = PointGroup.reflection("x")
SIGN = pseudoscalar(GROUP)
SWAP = {"left": "right", "right": "left", "stay": "stay"}
CHOICE = permutation(GROUP, list(SWAP), {"reflect-x": SWAP})
DISCRETE = Symmetry(GROUP, {"observation": SIGN * 2, "action": CHOICE, "mask": CHOICE})
STATE = torch.randn(6, 2, generator=torch.Generator().manual_seed(0))
BATCH = TensorDict(observation=STATE, batch_size=[6])


def test_terms_by_hand_for_all_elements_and_for_one_each():
    """Of the list, a row each; of drawn elements, the row that each has drawn."""
    act = make_symmetry("D3")["action"]
    source, output = torch.randn(5, ACTION_DIM), torch.randn(6, 5, ACTION_DIM)
    terms = mirror_error(output, source, act, range(6))
    expected = [[(output[g, b] - act(source[b], g)).pow(2).sum() for b in range(5)] for g in range(6)]
    torch.testing.assert_close(terms, torch.tensor(expected))
    assert torch.equal(mirror_error(output[[0, 4]], source, act, [0, 4]), terms[[0, 4]])
    drawn = torch.tensor([3, 0, 5, 5, 1])
    picked = output[drawn, torch.arange(5)]
    torch.testing.assert_close(mirror_error(picked, source, act, drawn), terms[drawn, torch.arange(5)])


@pytest.mark.parametrize("stop_gradient", [True, False])
def test_label_has_a_gradient_only_if_asked_for(stop_gradient):
    source, output = torch.ones(2, 1, requires_grad=True), torch.zeros(2, 2, 1, requires_grad=True)
    mirror_error(output, source, SIGN, [0, 1], stop_gradient=stop_gradient).sum().backward()
    assert output.grad.any() and (source.grad is None) == stop_gradient


def test_all_event_dimensions_are_summed():
    def two_agents_change_places(x, g):
        return x.flip(-2) if g else x

    two_agents_change_places.event_shape = (2, 3)
    source = torch.randn(4, 2, 3)
    output = torch.stack([source, torch.randn(4, 2, 3)])
    terms = mirror_error(output, source, two_agents_change_places, [0, 1])
    assert terms.shape == (2, 4) and not terms[0].any()
    torch.testing.assert_close(terms[1], (output[1] - source.flip(-2)).pow(2).sum((-1, -2)))


def action_values_by_hand(net):
    difference = net(-STATE) - net(STATE)[:, [1, 0, 2]]
    return difference.pow(2).sum(-1).mean()


@pytest.mark.parametrize("spec", [OneHot(3), Categorical(3)], ids=["one-hot", "categorical"])
@pytest.mark.parametrize("key", ["action_value", ("agent", "value")])
def test_arg_max_actor_by_its_action_values(spec, key):
    net = nn.Sequential(nn.Linear(2, 3), nn.Softplus())
    module = TensorDictModule(net, ["observation"], [key])
    actor = QValueActor(module, spec=spec, in_keys=["observation"], action_value_key=key)
    loss = MirrorLoss(actor, symmetry=DISCRETE)
    torch.testing.assert_close(loss(BATCH)["loss_mirror"], action_values_by_hand(net))
    assert gradients(loss, BATCH, [net]).any()


@pytest.mark.parametrize("composite", [False, True])
def test_one_hot_actor_by_its_probabilities(composite):
    net = nn.Linear(2, 3)
    if composite:
        out, options = [("params", "action", "logits")], {"distribution_map": {"action": OneHotCategorical}}
        kind, read = CompositeDistribution, ["params"]
    else:
        out, options, kind, read = ["logits"], {}, OneHotCategorical, ["logits"]
    module = TensorDictModule(net, ["observation"], out)
    actor = ProbabilisticActor(module, in_keys=read, distribution_class=kind, distribution_kwargs=options)
    value = MirrorLoss(actor, symmetry=DISCRETE)(BATCH)["loss_mirror"]
    torch.testing.assert_close(value, action_values_by_hand(lambda x: net(x).softmax(-1)))


def test_masked_one_hot_actor():
    net, mask = nn.Linear(2, 3), torch.tensor([[True, True, False], [False, True, True]]).repeat(3, 1)
    actor = ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["logits"]),
        in_keys={"logits": "logits", "mask": "mask"},
        distribution_class=MaskedOneHotCategorical,
    )
    data = BATCH.copy().set("mask", mask)
    value = MirrorLoss(actor, symmetry=DISCRETE)(data)["loss_mirror"]

    def probabilities(x, mask):
        return net(x).masked_fill(~mask, -torch.inf).softmax(-1)

    moved = probabilities(-STATE, mask[:, [1, 0, 2]]) - probabilities(STATE, mask)[:, [1, 0, 2]]
    torch.testing.assert_close(value, moved.pow(2).sum(-1).mean())


def test_actions_that_are_no_permutation_have_no_action_values():
    symmetry = Symmetry(GROUP, {"observation": SIGN * 2, "action": SIGN * 3})
    with pytest.raises(ValueError, match="expected a permutation for 'action'"):
        MirrorLoss(QValueActor(nn.Linear(2, 3), in_keys=["observation"], spec=OneHot(3)), symmetry=symmetry)


def test_distribution_of_returns_is_refused():
    actor = DistributionalQValueActor(
        nn.Linear(2, 3), spec=OneHot(3), in_keys=["observation"], support=torch.arange(4.0)
    )
    with pytest.raises(TypeError, match=r"distribution of returns.*SymmetryAugment"):
        MirrorLoss(actor, symmetry=DISCRETE)


def test_value_without_an_entry_of_its_own_is_refused():
    critic = TensorDictModule(lambda x: x.sum(-1), ["observation"], ["state_value"])
    with pytest.raises(ValueError, match=r"such as \(\*B, 1\), got \(6,\)"):
        MirrorLoss(critic, symmetry=DISCRETE, functional=False)(BATCH)


def test_networks_that_take_one_batch_dimension():
    """BatchNorm1d takes the second dimension for features: 6 rows by 6 features would pass unnoticed."""
    norm = nn.BatchNorm1d(6)
    norm.running_mean.copy_(torch.arange(6.0))
    net = nn.Sequential(nn.Linear(2, 6), norm, nn.Tanh(), nn.Linear(6, 3))
    value = MirrorLoss(
        TensorDictModule(net, ["observation"], ["action"]), symmetry=DISCRETE, functional=False
    )(BATCH)["loss_mirror"]
    torch.testing.assert_close(value, action_values_by_hand(net.eval()))


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_padded_rows_do_not_count_in_the_error_of_elements(reduction):
    data, mask = make_batch(4, 3), torch.arange(12).reshape(4, 3, 1) % 3 > 0
    data["observation"][~mask.squeeze(-1)] = 1e6
    loss = MirrorLoss(make_actor(), symmetry=make_symmetry("K4"), per_element=True, reduction=reduction)
    found = loss(data.set(("collector", "mask"), mask))
    expected = loss(data.exclude("collector")[mask.squeeze(-1)])
    torch.testing.assert_close(found["mirror_error"], expected["mirror_error"])
    if reduction != "none":
        torch.testing.assert_close(found["loss_mirror"], expected["loss_mirror"])


class NoWaiting(TorchDispatchMode):
    """Fails on operations for which the host would wait for the device, or copy to it."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        kwargs = kwargs or {}
        waits = ("_local_scalar_dense", "nonzero", "equal", "is_nonzero", "masked_select", "lift_fresh")
        assert name not in waits, name
        assert name != "_to_copy" or "device" not in kwargs, "a copy to another device"
        return func(*args, **kwargs)


def networks():
    policy = TensorDictModule(nn.Linear(OBSERVATION_DIM, ACTION_DIM), ["observation"], ["action"])
    yield from (make_actor(IndependentNormal), make_critic(), policy.double())


@pytest.mark.parametrize("stop_gradient", [True, False])
@pytest.mark.parametrize("group", ["K4", "D3"])
def test_host_does_not_wait(group, stop_gradient):
    mask = torch.ones(4, 3, 1, dtype=torch.bool)
    data = make_batch(4, 3).set(("collector", "mask"), mask)
    for network in networks():
        loss = MirrorLoss(
            network, symmetry=make_symmetry(group), stop_gradient=stop_gradient, per_element=True
        )
        loss(data)["loss_mirror"].backward()  # what is cached is cached
        with NoWaiting():
            loss(data)["loss_mirror"].backward()
    with pytest.raises(AssertionError, match="_local_scalar_dense"), NoWaiting():
        data["observation"].sum().item()


def test_default_device_of_somebody():
    data, symmetry = make_batch(), make_symmetry("D3")
    for network in networks():
        with torch.device("meta"):
            out = MirrorLoss(network, symmetry=symmetry, per_element=True)(data)
        assert all(value.device.type == "cpu" for value in out.values())


@pytest.mark.parametrize("group", ["K4", "D3"])
def test_follows_the_device_of_network_and_data(group):
    """Without to(device), and the caller's symmetry stays where it is."""
    symmetry = make_symmetry(group)
    for network in networks():
        loss = MirrorLoss(network.to("meta"), symmetry=symmetry, per_element=True)
        out = loss(make_batch(4, 3).to("meta"))
        out["loss_mirror"].backward()
        assert all(value.device.type == "meta" for value in out.values())
    loss.to("meta").bfloat16()
    assert torch.equal(symmetry(make_batch(), 1)["action"], make_symmetry(group)(make_batch(), 1)["action"])
