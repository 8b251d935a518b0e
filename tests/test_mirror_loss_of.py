"""MirrorLoss.of reaches the parameters that a loss trains: each member of each network of each loss."""

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.data import Bounded, OneHot
from torchrl.modules import (
    ActorValueOperator,
    OneHotCategorical,
    ProbabilisticActor,
    QValueActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.modules.models.batchrenorm import BatchRenorm1d
from torchrl.objectives import (
    A2CLoss,
    ClipPPOLoss,
    CQLLoss,
    CrossQLoss,
    DDPGLoss,
    DiscreteCQLLoss,
    DiscreteIQLLoss,
    DiscreteSACLoss,
    DQNLoss,
    IQLLoss,
    REDQLoss,
    ReinforceLoss,
    SACLoss,
    TD3BCLoss,
    TD3Loss,
    TQCLoss,
)

from tests.networks import ACTION_DIM, GROUPS, OBSERVATION_DIM, CatInputs, make_symmetry
from torchrl_sym import MirrorLoss, SymmetricClipPPOLoss, Symmetry
from torchrl_sym.representations import permutation

pytestmark = pytest.mark.filterwarnings(
    "ignore:No target network updater", "ignore:MirrorLoss has been given"
)

SPEC = Bounded(-1, 1, (ACTION_DIM,))
STATE, PAIR = ["observation"], ["observation", "action"]
SWAPS = {
    "reflect-x": {"forward": "back", "back": "forward", "left": "left", "right": "right"},
    "reflect-y": {"forward": "forward", "back": "back", "left": "right", "right": "left"},
}


def mlp(inputs, outputs, *more):
    return nn.Sequential(nn.Linear(inputs, 8), nn.Tanh(), *more, nn.Linear(8, outputs))


def gaussian():
    net = nn.Sequential(mlp(OBSERVATION_DIM, 2 * ACTION_DIM), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(net, STATE, ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
        spec=SPEC,
    )


def one_hot():
    net = TensorDictModule(mlp(OBSERVATION_DIM, 4), STATE, ["logits"])
    return ProbabilisticActor(net, in_keys=["logits"], distribution_class=OneHotCategorical)


def deterministic():
    return TensorDictModule(nn.Sequential(mlp(OBSERVATION_DIM, ACTION_DIM), nn.Tanh()), STATE, ["action"])


def q(outputs=1, *more):
    net = CatInputs(mlp(OBSERVATION_DIM + ACTION_DIM, outputs, *more))
    return TensorDictModule(net, PAIR, ["state_action_value"])


def v():
    return ValueOperator(mlp(OBSERVATION_DIM, 1), in_keys=STATE)


def action_values():
    return TensorDictModule(mlp(OBSERVATION_DIM, 4), STATE, ["action_value"])


def arg_max():
    return QValueActor(mlp(OBSERVATION_DIM, 4), in_keys=STATE, spec=OneHot(4))


def ppo(**kwargs):
    return ClipPPOLoss(gaussian(), v(), **kwargs)


def symmetric_ppo():
    return SymmetricClipPPOLoss(gaussian(), v(), symmetry=symmetry())


def shared_trunk(**kwargs):
    trunk = TensorDictModule(nn.Sequential(nn.Linear(OBSERVATION_DIM, 16), nn.Tanh()), STATE, ["hidden"])
    head = nn.Sequential(nn.Linear(16, 2 * ACTION_DIM), NormalParamExtractor())
    policy = ProbabilisticActor(
        TensorDictModule(head, ["hidden"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    both = ActorValueOperator(trunk, policy, ValueOperator(nn.Linear(16, 1), in_keys=["hidden"]))
    return ClipPPOLoss(both.get_policy_operator(), both.get_value_operator(), **kwargs)


def normalised_q():
    return q(1, BatchRenorm1d(8), nn.Dropout(0.3))


LOSSES = {
    "SAC qvalue_network": lambda: SACLoss(gaussian(), q(), action_spec=SPEC),
    "SAC of two modules qvalue_network": lambda: SACLoss(gaussian(), [q(), q()], action_spec=SPEC),
    "SAC actor_network": lambda: SACLoss(gaussian(), q(), action_spec=SPEC),
    "SAC delayed actor_network": lambda: SACLoss(gaussian(), q(), action_spec=SPEC, delay_actor=True),
    "SAC with V value_network": lambda: SACLoss(gaussian(), q(), v(), action_spec=SPEC),
    "TD3 qvalue_network": lambda: TD3Loss(deterministic(), q(), action_spec=SPEC),
    "TD3 actor_network": lambda: TD3Loss(deterministic(), q(), action_spec=SPEC),
    "TD3BC qvalue_network": lambda: TD3BCLoss(deterministic(), q(), action_spec=SPEC),
    "DDPG value_network": lambda: DDPGLoss(deterministic(), q()),
    "REDQ qvalue_network": lambda: REDQLoss(gaussian(), q(), action_spec=SPEC, num_qvalue_nets=3),
    "CrossQ qvalue_network": lambda: CrossQLoss(gaussian(), normalised_q(), action_spec=SPEC),
    "TQC qvalue_network": lambda: TQCLoss(gaussian(), q(5), action_spec=SPEC),
    "IQL qvalue_network": lambda: IQLLoss(gaussian(), q(), v()),
    "IQL of one qvalue_network": lambda: IQLLoss(gaussian(), q(), v(), num_qvalue_nets=1),
    "IQL value_network": lambda: IQLLoss(gaussian(), q(), v()),
    "CQL qvalue_network": lambda: CQLLoss(gaussian(), q(), action_spec=SPEC),
    "DQN value_network": lambda: DQNLoss(arg_max(), action_space="one-hot"),
    "DiscreteCQL value_network": lambda: DiscreteCQLLoss(arg_max(), action_space="one-hot"),
    "DiscreteSAC qvalue_network": lambda: DiscreteSACLoss(
        one_hot(), action_values(), action_space="one-hot", num_actions=4
    ),
    "DiscreteSAC actor_network": lambda: DiscreteSACLoss(
        one_hot(), action_values(), action_space="one-hot", num_actions=4
    ),
    "DiscreteIQL qvalue_network": lambda: DiscreteIQLLoss(
        one_hot(), action_values(), v(), action_space="one-hot"
    ),
    "PPO critic_network": ppo,
    "PPO actor_network": ppo,
    "PPO not functional critic_network": lambda: ppo(functional=False),
    "PPO not functional actor_network": lambda: ppo(functional=False),
    "symmetric PPO critic_network": symmetric_ppo,
    "PPO shared critic_network": shared_trunk,
    "PPO shared, separate critic_network": lambda: shared_trunk(separate_losses=True),
    "A2C critic_network": lambda: A2CLoss(gaussian(), v()),
    "Reinforce critic_network": lambda: ReinforceLoss(gaussian(), v()),
}


def symmetry(discrete=False):
    base, group = make_symmetry("K4"), GROUPS["K4"]
    action = permutation(group, list(SWAPS["reflect-x"]), SWAPS) if discrete else base["action"]
    return Symmetry(group, {"observation": base["observation"], "action": action})


def make(name, **options):
    torch.manual_seed(0)
    loss, network = LOSSES[name](), name.split()[-1]
    discrete = name.startswith("D") and not name.startswith("DDPG")
    return loss, network, MirrorLoss.of(loss, network, symmetry=symmetry(discrete), **options)


def batch(rows=64, seed=1):
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(rows, OBSERVATION_DIM, generator=generator)
    action = torch.rand(rows, ACTION_DIM, generator=generator) * 2 - 1
    return TensorDict(observation=observation, action=action, batch_size=[rows])


def member_errors(loss, network, sym, data):
    """sum_g E || K_g[f(s)] - f(L_g s) ||^2 of each member, by its own parameters."""
    net, params = getattr(loss, network), getattr(loss, f"{network}_params", None)
    if params is None:
        params = TensorDict.from_module(net)
    members = params.data.unbind(0) if params.batch_dims else [params.data]
    if "action" not in net.in_keys:
        data = data.exclude("action")
    errors = []
    for member in members:
        with torch.no_grad(), member.to_module(net, preserve_module_state=False):
            modes = {part: part.training for part in net.modules()}
            net.eval()
            outputs = [output(net, sym(data, g)) for g in range(sym.group.order)]
            for part, mode in modes.items():
                part.training = mode
        is_value = outputs[0].shape[-1] not in (ACTION_DIM, 4)
        images = [outputs[0] if is_value else sym["action"](outputs[0], g) for g in range(len(outputs))]
        differences = [(x - y).pow(2).sum(-1).mean() for x, y in zip(outputs, images, strict=True)]
        errors.append(sum(differences).item())
    return errors


def output(net, data):
    if hasattr(net, "get_dist"):
        dist = net.get_dist(data)
        return dist.probs if isinstance(dist, OneHotCategorical) else dist.deterministic_sample
    out = net(data)
    names = ("action_value", "state_action_value", "state_value", "action")
    return next(out[name] for name in names if name in net.out_keys)


@pytest.mark.parametrize("name", LOSSES)
def test_trains_every_member_of_every_network(name):
    loss, network, mirror = make(name)
    data, sym = batch(), mirror.symmetry
    before = member_errors(loss, network, sym, data)
    torch.testing.assert_close(mirror(data)["loss_mirror"].item(), sum(before), rtol=1e-4, atol=0)

    optimizer = torch.optim.Adam([p for p in loss.parameters() if p.requires_grad], 0.05)
    for _ in range(40):
        optimizer.zero_grad()
        mirror(data)["loss_mirror"].backward()
        optimizer.step()
    after = member_errors(loss, network, sym, data)
    assert len(after) == {"SAC": 2, "REDQ": 3}.get(name.removesuffix(" qvalue_network"), len(after))
    assert all(y < 0.1 * x for x, y in zip(before, after, strict=True)), (before, after)


@pytest.mark.parametrize("name", ["SAC qvalue_network", "PPO not functional critic_network"])
def test_registers_nothing_a_second_time(name):
    loss, _, mirror = make(name)
    assert not [*mirror.parameters()] and [*mirror.state_dict()] == ["coeff"]
    both = [*loss.parameters(), *mirror.parameters()]
    assert len({id(p) for p in both}) == len(both)


def test_adds_to_the_gradient_of_the_loss_and_leaves_targets_alone():
    loss, _, mirror = make("SAC qvalue_network", coeff=0.5)
    targets = loss.target_qvalue_network_params.clone()
    mirror(batch())["loss_mirror"].backward()
    reached = {name for name, p in loss.named_parameters() if p.grad is not None and p.grad.any()}
    assert reached and all(name.startswith("qvalue_network_params") for name in reached)
    assert (loss.target_qvalue_network_params == targets).all()


def test_each_member_has_the_gradient_that_it_would_have_alone():
    networks = [q(), q(), q()]
    alone = [MirrorLoss(copy.deepcopy(net), symmetry=symmetry()) for net in networks]
    loss = REDQLoss(gaussian(), networks, action_spec=SPEC, num_qvalue_nets=3)
    mirror, data = MirrorLoss.of(loss, symmetry=symmetry(), per_element=True), batch()
    together = mirror(data)
    together["loss_mirror"].backward()
    values = [single(data)["loss_mirror"] for single in alone]
    torch.testing.assert_close(together["loss_mirror"], sum(values))
    torch.testing.assert_close(together["mirror_error"].sum(), together["loss_mirror"].detach())
    for member, value in enumerate(values):
        value.backward()
        for key, p in alone[member].actor_network_params.items(True, True):
            torch.testing.assert_close(loss.qvalue_network_params[key].grad[member], p.grad)


def test_trunk_that_the_loss_detaches_stays_detached():
    for separate in (False, True):
        torch.manual_seed(0)
        loss = shared_trunk(separate_losses=separate)
        mirror = MirrorLoss.of(loss, "critic_network", symmetry=symmetry())
        mirror(batch())["loss_mirror"].backward()
        trunk = loss.actor_network_params["module", "0", "module", "0", "weight"]
        assert (trunk.grad is None) == separate


def test_normalised_network_is_a_function_of_one_row():
    """By the running statistics, without dropout; neither the statistics nor the modes change."""
    loss, network, mirror = make("CrossQ qvalue_network")
    data = batch()
    with loss.qvalue_network_params[0].to_module(loss.qvalue_network, preserve_module_state=False):
        loss.qvalue_network(data.clone())  # statistics other than 0 and 1
    buffers = {name: buffer.clone() for name, buffer in loss.named_buffers()}
    modes = [part.training for part in loss.qvalue_network.modules()]
    assert any("running_mean" in name and buffer.any() for name, buffer in buffers.items())
    value = mirror(data)["loss_mirror"].item()
    assert value == mirror(data)["loss_mirror"].item()
    assert value == pytest.approx(sum(member_errors(loss, network, mirror.symmetry, data)), rel=1e-4)
    single = [mirror(data[row : row + 1])["loss_mirror"].item() for row in range(len(data))]
    assert value == pytest.approx(sum(single) / len(single), rel=1e-4)
    assert all(torch.equal(buffers[name], buffer) for name, buffer in loss.named_buffers())
    assert modes == [part.training for part in loss.qvalue_network.modules()] and all(modes)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_stay_together(duplicate):
    loss, mirror = duplicate(make("PPO critic_network")[::2])
    mirror(batch())["loss_mirror"].backward()
    assert all(p.grad is not None for p in loss.critic_network_params.parameters())


def test_follows_the_loss_to_another_precision():
    loss, _, mirror = make("TD3 qvalue_network")
    loss.double()
    assert mirror(batch().double())["loss_mirror"].dtype == torch.float64


def test_keys_of_the_loss():
    names = {"observation": ("agent", "state"), "action": ("agent", "move"), "state_action_value": "q"}
    net = CatInputs(mlp(OBSERVATION_DIM + ACTION_DIM, 1))
    critic = TensorDictModule(net, [names["observation"], names["action"]], ["q"])
    actor = TensorDictModule(mlp(OBSERVATION_DIM, ACTION_DIM), [names["observation"]], [names["action"]])
    loss = TD3Loss(actor, critic, bounds=(-1.0, 1.0))
    loss.set_keys(action=names["action"], state_action_value="q")
    data, sym = batch(), make_symmetry("K4", names["observation"], names["action"])
    data = data.rename_key_("observation", names["observation"]).rename_key_("action", names["action"])
    for network in ("qvalue_network", "actor_network"):
        assert MirrorLoss.of(loss, network, symmetry=sym)(data)["loss_mirror"] > 0


def test_what_cannot_be_reached_is_named():
    loss = SACLoss(gaussian(), q(), action_spec=SPEC)
    listed = r"network: expected one of \['actor_network', 'qvalue_network'\], got "
    with pytest.raises(ValueError, match=listed + "'value_network'; did you mean"):
        MirrorLoss.of(loss, "value_network", symmetry=symmetry())
    with pytest.raises(ValueError, match=r"\['actor_network', 'value_network'\], got 'actor_critic'"):
        MirrorLoss.of(DDPGLoss(deterministic(), q()), "actor_critic", symmetry=symmetry())
    with pytest.raises(TypeError, match="loss: expected LossModule"):
        MirrorLoss.of(q(), "qvalue_network", symmetry=symmetry())
    with pytest.raises(TypeError, match="got 'coef'; did you mean 'coeff'"):
        MirrorLoss.of(loss, "qvalue_network", symmetry=symmetry(), coef=1.0)
    with pytest.raises(TypeError, match="got 'functional'"):
        MirrorLoss.of(loss, "qvalue_network", symmetry=symmetry(), functional=True)
    with pytest.raises(KeyError, match=r"reads \['action'\], which this symmetry does not transform"):
        state = make_symmetry("K4")["observation"]
        MirrorLoss.of(loss, symmetry=Symmetry(GROUPS["K4"], {"observation": state}))


def test_head_of_a_trunk_that_the_actor_runs_is_refused():
    loss = ClipPPOLoss(gaussian(), ValueOperator(nn.Linear(8, 1), in_keys=["hidden"]))
    with pytest.raises(KeyError, match="hidden"):
        MirrorLoss.of(loss, "critic_network", symmetry=symmetry())
