"""A mirror loss that moves nothing says so; one that moves its network never does."""

import copy

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import SACLoss, TD3Loss

from tests.networks import ACTION_DIM, OBSERVATION_DIM, make_actor, make_batch, make_critic, make_symmetry
from torchrl_sym import MirrorLoss

pytestmark = pytest.mark.filterwarnings("ignore:No target network", "ignore:MirrorLoss has been given")
REMEDY = r"no optimizer holds them.*MirrorLoss\.of\(loss, 'qvalue_network'"
STEPS = 30


class CatInputs(nn.Module):
    def __init__(self):
        super().__init__()
        self.net = nn.Linear(OBSERVATION_DIM + ACTION_DIM, 1, dtype=torch.float64)

    def forward(self, observation, action):
        return self.net(torch.cat([observation, action], -1)).pow(2)


def q(value="state_action_value"):
    return TensorDictModule(CatInputs(), ["observation", "action"], [value])


def mirror(network, **options):
    loss = MirrorLoss(network, symmetry=make_symmetry(), **options)
    loss.patience = 10
    return loss


def train(loss, optimizer, steps=STEPS, set_to_none=True, every=1):
    data = make_batch()
    for step in range(steps):
        loss(data)["loss_mirror"].backward()
        if optimizer is not None and step % every == every - 1:
            optimizer.step()
            optimizer.zero_grad(set_to_none=set_to_none)


@pytest.mark.parametrize("functional", [True, False])
def test_copy_that_no_optimizer_holds(functional):
    critic, actor = q(), TensorDictModule(nn.Linear(4, 3).double(), ["observation"], ["action"])
    loss = mirror(critic, functional=functional)
    td3 = TD3Loss(actor, critic, bounds=(-1.0, 1.0))
    optimizer = torch.optim.Adam(td3.parameters())
    with pytest.raises(RuntimeError, match=REMEDY):
        train(loss, optimizer)


def test_patience_is_a_hundred():
    loss, data = MirrorLoss(make_critic(), symmetry=make_symmetry()), make_batch()
    for _ in range(100):
        loss(data)["loss_mirror"].backward()
    with pytest.raises(RuntimeError, match="100 gradients"):
        for _ in range(5):
            loss(data)["loss_mirror"].backward()


@pytest.mark.parametrize("duplicate_after", [0, 7])
def test_copied_loss_has_a_network_of_its_own(duplicate_after):
    actor = make_actor()
    loss, optimizer = mirror(actor), torch.optim.Adam(actor.parameters())
    train(loss, None, duplicate_after)
    with pytest.raises(RuntimeError, match="no optimizer holds them"):
        train(copy.deepcopy(loss), optimizer)


def test_inner_network_of_a_loss():
    critic = q()
    sac = SACLoss(make_actor(), critic, target_entropy=-1.0)
    with pytest.raises(RuntimeError, match="no optimizer holds them"):
        train(mirror(sac.qvalue_network), torch.optim.SGD(sac.parameters(), 1e-3))
    reaching = MirrorLoss.of(sac, symmetry=make_symmetry())
    reaching.patience = 10
    with pytest.raises(RuntimeError, match="no optimizer holds them; give those of the loss to one"):
        train(copy.deepcopy(reaching), None)
    train(reaching, torch.optim.SGD(sac.parameters(), 1e-3))


@pytest.mark.parametrize("set_to_none", [True, False])
@pytest.mark.parametrize("kind", [{"foreach": True}, {"foreach": False}, {"fused": True}], ids=str)
@pytest.mark.parametrize("optimizer", [torch.optim.Adam, torch.optim.SGD])
def test_trained_network(optimizer, kind, set_to_none):
    actor = make_actor()
    train(mirror(actor), optimizer(actor.parameters(), lr=1e-3, **kind), set_to_none=set_to_none)


def test_gradients_that_are_added_up():
    actor = make_actor()
    train(mirror(actor), torch.optim.SGD(actor.parameters(), 1e-3), every=9)


def test_network_that_is_trained_in_part():
    actor = make_actor()
    train(mirror(actor), torch.optim.SGD(actor[0].module[2].parameters(), 1e-3))


def test_network_that_is_trained_later():
    """Its optimizer clears the gradients, and does not step yet."""
    actor = make_actor()
    optimizer = torch.optim.SGD(actor.parameters(), 1e-3)
    optimizer.step = lambda: None
    train(mirror(actor), optimizer)


@pytest.mark.parametrize("every", [0, 4])
def test_network_that_was_trained_before(every):
    """Optimizers that set gradients to zero leave high counters; then it is evaluated, or accumulated."""
    actor, data = make_actor(), make_batch()
    optimizer = torch.optim.SGD(actor.parameters(), 1e-3)
    for _ in range(150):
        actor.get_dist(data).deterministic_sample.sum().backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=False)
    loss = mirror(actor)
    if every:
        train(loss, optimizer, every=every, set_to_none=False)
    else:
        for _ in range(STEPS):
            loss(data)


def test_frozen_network_beside_one_that_learns():
    loss, other = mirror(make_actor().requires_grad_(False)), nn.Linear(1, 1)
    for _ in range(STEPS):
        (loss(make_batch())["loss_mirror"] + other.weight.sum()).backward()


def test_metric_of_a_network_that_is_trained_elsewhere():
    loss, data = mirror(make_actor()), make_batch()
    train(loss, None, 8)
    with torch.no_grad():
        for _ in range(STEPS):
            loss(data)


def test_q_function_is_warned_of():
    for critic in (q(), TensorDictModule(nn.Linear(4, 3).double(), ["observation"], ["action_value"])):
        with pytest.warns(UserWarning, match="use MirrorLoss.of"):
            loss = MirrorLoss(critic, symmetry=make_symmetry("C1"))
    named = q("q")
    loss = MirrorLoss(named, symmetry=make_symmetry())
    loss.set_keys(value="q")
    with pytest.warns(UserWarning, match="use MirrorLoss.of"):
        loss(make_batch())


@pytest.mark.filterwarnings("error")
def test_other_networks_are_not_warned_of():
    for network in (make_actor(), make_critic()):
        MirrorLoss(network, symmetry=make_symmetry())(make_batch())
    td3 = TD3Loss(TensorDictModule(nn.Linear(4, 3), ["observation"], ["action"]), q(), bounds=(-1.0, 1.0))
    MirrorLoss.of(td3, symmetry=make_symmetry())(make_batch())


@pytest.mark.parametrize("cut", [torch.detach, torch.round, lambda x: (x == x.amax(-1, True)).double()])
def test_output_without_a_gradient(cut):
    net = nn.Linear(OBSERVATION_DIM, ACTION_DIM).double()
    policy = TensorDictModule(lambda x: cut(net(x)).detach(), ["observation"], ["action"])
    policy.net = net
    loss = mirror(policy, functional=False)
    with pytest.raises(RuntimeError, match="expected an output with a gradient"):
        loss(make_batch())
    with torch.no_grad():
        loss(make_batch())
    policy.requires_grad_(False)
    loss(make_batch())
