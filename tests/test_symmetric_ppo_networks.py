"""Losses on networks beyond one actor and one critic: agents, shared trunks, one-hot actions, devices."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.modules import (
    ActorValueOperator,
    IndependentNormal,
    OneHotCategorical,
    ProbabilisticActor,
    ValueOperator,
)
from torchrl.objectives import ClipPPOLoss

from tests.networks import make_actor, make_batch, make_symmetry
from torchrl_sym import MirrorLoss, PointGroup, SymmetricClipPPOLoss, Symmetry, SymmetryAugment
from torchrl_sym.entries import split
from torchrl_sym.representations import invariant, items, permutation, pseudoscalar

GROUP = PointGroup.reflection("x")
SIGN = pseudoscalar(GROUP)
SYMMETRY = Symmetry(GROUP, {"observation": SIGN * 3, "action": SIGN})


def gaussian(net, in_keys=("observation",), **kwargs):
    return ProbabilisticActor(
        TensorDictModule(nn.Sequential(net, NormalParamExtractor()), list(in_keys), ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
        **kwargs,
    )


def batch_of(*shape):
    generator = torch.Generator().manual_seed(0)
    return TensorDict(
        observation=torch.randn(*shape, 3, generator=generator),
        action=torch.randn(*shape, 1, generator=generator),
        action_log_prob=-torch.rand(*shape, generator=generator),
        advantage=torch.randn(*shape, 1, generator=generator),
        value_target=torch.randn(*shape, 1, generator=generator),
        batch_size=shape[:1],
    )


@pytest.mark.parametrize("agents", [2, 6])
def test_random_elements_with_agents_agree_with_one_row_per_agent(agents):
    torch.manual_seed(0)
    actor, critic = gaussian(nn.Linear(3, 2)), ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
    places = invariant(GROUP, agents)
    symmetry = Symmetry(GROUP, {"observation": items(places, SIGN * 3), "action": items(places, SIGN)})
    loss = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry, elements="random", mirror_coeff=0.5)
    batch = batch_of(6, agents)
    torch.manual_seed(1)
    element = torch.randint(2, (6,))
    torch.manual_seed(1)
    out = loss(batch)
    mapped = symmetry(batch.select("observation", "action"), element).update(
        batch.exclude("observation", "action")
    )
    plain = ClipPPOLoss(actor, critic)
    torch.testing.assert_close(out["loss_objective"], plain(mapped)["loss_objective"])
    originals = plain(batch[element == 0])
    for key in ("kl_approx", "entropy", "clip_fraction", "mean_ratio"):
        torch.testing.assert_close(out[key], originals[key], msg=key)
    assert out["loss_mirror"] > 0


def test_critic_may_read_what_the_actor_computes():
    trunk = TensorDictModule(nn.Linear(3, 8), ["observation"], ["hidden"])
    policy, value = (
        gaussian(nn.Linear(8, 2), ["hidden"]),
        ValueOperator(nn.Linear(8, 1), in_keys=["hidden"]),
    )
    both = ActorValueOperator(trunk, policy, value)
    head = both.get_value_head()
    loss = SymmetricClipPPOLoss(both.get_policy_operator(), head, symmetry=SYMMETRY)
    batch = batch_of(5)
    stale = batch.clone().set("hidden", torch.full((5, 8), torch.nan))
    assert loss(batch)["loss_critic"].isfinite()
    assert torch.equal(loss(stale)["loss_critic"], loss(batch)["loss_critic"])


READ = ["mask", "index", "returns", "reward", "step_count", "_hidden", "any_log_prob", ("collector", "x")]


@pytest.mark.parametrize("key", READ, ids=str)
def test_what_a_network_reads_must_be_declared_whatever_its_name(key):
    actor, critic = (
        gaussian(nn.Linear(4, 2), ["observation", key]),
        ValueOperator(nn.Linear(3, 1), in_keys=["observation"]),
    )
    with pytest.raises(KeyError, match=f"the actor reads .*{split(key)[1]}"):
        SymmetricClipPPOLoss(actor, critic, symmetry=SYMMETRY)
    with pytest.raises(KeyError, match="the network reads"):
        MirrorLoss(actor, symmetry=SYMMETRY)
    declared = Symmetry(GROUP, {"observation": SIGN * 3, "action": SIGN, key: invariant(GROUP, 1)})
    SymmetricClipPPOLoss(actor, critic, symmetry=declared)
    SYMMETRY.require(["observation", "is_init"], "the actor")


def test_mirror_loss_of_one_hot_actions_compares_probabilities():
    group = PointGroup.reflection("y")
    swap = permutation(group, ["left", "right"], {"reflect-y": {"left": "right", "right": "left"}})
    symmetry = Symmetry(group, {"observation": invariant(group, 3), "action": swap})
    actor = ProbabilisticActor(
        TensorDictModule(nn.Linear(3, 2), ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=OneHotCategorical,
    )
    batch = TensorDict(observation=torch.ones(4, 3), batch_size=[4])
    value = MirrorLoss(actor, symmetry=symmetry)(batch)["loss_mirror"]
    p = actor.get_dist(batch).probs[0]
    torch.testing.assert_close(value, 2 * (p[0] - p[1]) ** 2)
    value.backward()


def test_integer_actions_are_refused():
    actor = ProbabilisticActor(
        TensorDictModule(nn.Linear(3, 2), ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
    )
    with pytest.raises(TypeError, match="use one-hot actions"):
        MirrorLoss(actor, symmetry=SYMMETRY)(batch_of(4))


def test_moving_a_loss_leaves_the_symmetry_where_it_is():
    symmetry = make_symmetry()
    MirrorLoss(make_actor(), symmetry=symmetry).to("meta")
    assert SymmetryAugment(symmetry)(make_batch(4)).batch_size == torch.Size([8])


def test_missing_observation_is_named():
    actor, critic = gaussian(nn.Linear(3, 2)), ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
    batch = batch_of(4).exclude("observation")
    for loss in (
        SymmetricClipPPOLoss(actor, critic, symmetry=SYMMETRY),
        MirrorLoss(actor, symmetry=SYMMETRY),
    ):
        with pytest.raises(KeyError, match="expected an entry 'observation'"):
            loss(batch)


@pytest.mark.parametrize(
    ("g", "error"),
    [
        (torch.tensor([True, False]), "got torch.bool"),
        (torch.tensor([0.0, 1.0]), "got torch.float32"),
        (torch.tensor([0]), r"of shape \(1,\)"),
        (torch.tensor([0, -1]), "got -1 to 0"),
        (torch.tensor([0, 2]), "got 0 to 2"),
    ],
)
def test_element_tensors_are_checked(g, error):
    with pytest.raises((ValueError, KeyError), match=error):
        SIGN(torch.ones(2, 1), g)
