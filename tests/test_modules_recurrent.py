"""Equivariant LSTM and GRU: PyTorch's, exact in their memory, inside TorchRL's modules and losses."""

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.modules import GRUModule, IndependentNormal, LSTMModule, ProbabilisticActor, set_recurrent_mode
from torchrl.objectives import ClipPPOLoss

import tasks
from tests.equivariant import TOLERANCE, assert_same_losses, by_dtype, by_group, entries
from tests.point_groups import GROUPS, assert_close, random
from tests.recurrent import ENVS, EPISODE, GROUP, SIGN, with_advantage
from torchrl_sym import SymmetricClipPPOLoss, Symmetry
from torchrl_sym.memory import memory_keys
from torchrl_sym.modules import EquivariantGRU, EquivariantLinear, EquivariantLSTM, InvariantMLP, TiedScale
from torchrl_sym.representations import polar
from torchrl_sym.testing import assert_equivariant

by_kind = pytest.mark.parametrize("kind", [EquivariantGRU, EquivariantLSTM], ids=["GRU", "LSTM"])
PLAIN = {EquivariantGRU: nn.GRU, EquivariantLSTM: nn.LSTM}
INSIDE = {EquivariantGRU: (GRUModule, "gru"), EquivariantLSTM: (LSTMModule, "lstm")}


def make(group, kind, **kwargs):
    torch.manual_seed(0)
    return kind(entries(group), 2 * group.order, num_layers=2, **kwargs)


def memory(network, batch: int):
    """Some memory, of one or two states."""
    shape = network.num_layers, batch, network.hidden_size
    states = [random(*shape, seed=seed, dtype=network.input_linears[0].weight.dtype) for seed in (1, 2)]
    return states[0] if network.states == 1 else tuple(states)


def flat(states) -> list:
    return [states] if isinstance(states, torch.Tensor) else list(states)


@by_kind
@pytest.mark.parametrize("bias", [True, False])
def test_they_are_pytorchs_layers_with_equivariant_weights(kind, bias):
    network = make(GROUPS["D3"], kind, bias=bias, dtype=torch.float64)
    plain = PLAIN[kind](
        network.input_size, network.hidden_size, 2, bias=bias, batch_first=True, dtype=torch.float64
    )
    with torch.no_grad():
        for parameter, weight in zip(plain.parameters(), network._weights(), strict=True):
            assert parameter.shape == weight.shape
            parameter.copy_(weight)
    x = random(3, 7, network.input_size)
    for start in (None, memory(network, 3)):
        (y, states), (expected, wanted) = network(x, start), plain(x, start)
        assert_close(y, expected)
        for one, other in zip(flat(states), flat(wanted), strict=True):
            assert_close(one, other)


@by_dtype
@by_group
@by_kind
def test_the_memory_of_a_mirrored_history_is_the_permuted_memory(kind, group, dtype):
    network = make(group, kind, dtype=dtype)
    x = random(3, 9, network.input_size, dtype=dtype)
    start = memory(network, 3)
    y, states = network(x, start)
    assert y.abs().max() > 0.01
    for g in range(group.order):
        images = [network.out_rep(state, g) for state in flat(start)]
        mirrored, after = network(network.in_rep(x, g), images[0] if len(images) == 1 else tuple(images))
        assert_close(mirrored, network.out_rep(y, g), TOLERANCE[dtype])
        for one, other in zip(flat(after), flat(states), strict=True):
            assert_close(one, network.out_rep(other, g), TOLERANCE[dtype])
            stored = network.memory_rep(other.transpose(0, 1), g)  # as TorchRL keeps it
            assert_close(one.transpose(0, 1), stored, TOLERANCE[dtype])


@by_kind
def test_initial_weights_vary_as_pytorchs(kind):
    torch.manual_seed(0)
    group = GROUPS["K4"]
    ours = kind(entries(group), 256)
    plain = PLAIN[kind](ours.input_size, 256)
    for parameter, weight in zip(plain.parameters(), ours._weights(), strict=True):
        assert abs(weight.var() / parameter.var() - 1) < 0.25


@by_kind
def test_masked_sequences_end_where_they_end(kind):
    network = make(GROUPS["C3"], kind, dtype=torch.float64)
    x, lengths = random(4, 6, network.input_size), [2, 6, 1, 4]
    start = memory(network, 4)
    mask = torch.arange(6) < torch.tensor(lengths)[:, None]
    y, states = network(x, start, mask=mask)
    for row, length in enumerate(lengths):
        own = [state[:, row : row + 1].contiguous() for state in flat(start)]
        alone, after = network(x[row : row + 1, :length], own[0] if len(own) == 1 else tuple(own))
        assert_close(y[row, :length], alone[0])
        for one, other in zip(flat(states), flat(after), strict=True):
            assert_close(one[:, row], other[:, 0])


@by_kind
def test_saved_copied_pickled_and_in_other_precisions(kind):
    network = make(GROUPS["D3"], kind)
    x = random(2, 4, network.input_size, dtype=torch.float32)
    other = kind(network.in_rep, network.hidden_size, num_layers=2)
    other.load_state_dict(network.state_dict())
    for same in (other, copy.deepcopy(network), pickle.loads(pickle.dumps(network))):
        assert torch.equal(same(x)[0], network(x)[0])
    exact = network.double()
    assert_equivariant(
        lambda x: exact(x)[0], exact.in_rep, exact.out_rep, inputs=x.double(), tolerance=1e-12
    )
    count = sum(parameter.numel() for parameter in network.parameters())
    dense = sum(weight.numel() for weight in network._weights())
    assert count < dense / 5  # an input of few copies of some irreducible representations has not quite 1/6


def test_sizes_and_inputs_are_checked():
    group = GROUPS["D3"]
    with pytest.raises(
        ValueError, match=r"hidden_size: expected multiples of 6.*got 64; the next one is 66"
    ):
        EquivariantGRU(polar(group), 64)
    with pytest.raises(ValueError, match=r"expected sequences \(batch, time, 3\), got .*\(5, 3\)"):
        EquivariantGRU(polar(group), 6)(torch.zeros(5, 3))


# --- in TorchRL


def make_policy(kind, units: int = 6) -> ProbabilisticActor:
    torch.manual_seed(0)
    network = kind(SIGN * 3, units)
    wrapper, name = INSIDE[kind]
    module = wrapper(**{name: network}, in_key="observation", out_key="feature")
    head = nn.Sequential(EquivariantLinear(network.out_rep, SIGN), TiedScale(SIGN))
    return ProbabilisticActor(
        TensorDictSequential(module, TensorDictModule(head, ["feature"], ["loc", "scale"])),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )


def inner(policy, kind):
    return getattr(policy[0][0], INSIDE[kind][1])


def collected(policy, horizon: int) -> TensorDict:
    """The second batch of a collector, which begins within episodes and has ends of episodes inside."""
    base = tasks.make_env("cartpole", num_envs=ENVS, seed=0, episode_seconds=EPISODE * 0.02)
    env = TransformedEnv(base, InitTracker())
    env.append_transform(policy[0][0].make_tensordict_primer())
    collector = Collector(env, policy, frames_per_batch=ENVS * horizon, total_frames=2 * ENVS * horizon)
    batch = [with_advantage(batch.clone()) for batch in collector][1]
    collector.shutdown()
    return batch


@by_kind
def test_copies_begin_with_the_image_of_the_stored_memory_anywhere(kind):
    policy = make_policy(kind)
    batch = collected(policy, 7)
    keys = memory_keys(policy)
    assert batch["is_init"][:, 1:].any() and batch[keys[0]][:, 0].any()
    stored = dict.fromkeys(keys, inner(policy, kind).memory_rep)
    symmetry = Symmetry(GROUP, {"observation": SIGN * 3, "action": SIGN} | stored)
    critic = TensorDictModule(InvariantMLP(SIGN * 3, 1, (8,)), ["observation"], ["state_value"])
    loss = SymmetricClipPPOLoss(policy, critic, symmetry=symmetry, mirror_coeff=1.0)
    plain = ClipPPOLoss(policy, critic)
    batch["advantage"], batch["value_target"] = torch.randn(2, *batch.shape, 1)
    assert_same_losses(loss, plain, batch)


@by_kind
def test_sequences_are_what_steps_are(kind):
    policy = make_policy(kind)
    module, keys = policy[0][0], memory_keys(policy)
    batch = TensorDict(observation=torch.randn(3, 6, 3), batch_size=[3, 6])
    batch["is_init"] = torch.rand(3, 6, 1) < 0.4
    for key in keys:
        batch[key] = torch.randn(3, 6, 1, 6)
    outputs, step = [], batch[:, 0].clone()
    with torch.no_grad():
        for t in range(6):
            step["observation"], step["is_init"] = batch["observation"][:, t], batch["is_init"][:, t]
            outputs.append(module(step)["feature"])
            for key in keys:
                step[key] = step["next", key]
        for key in keys:  # TorchRL zeroes the memory at a start in single steps only
            batch[key] = torch.where(batch["is_init"][..., None], 0.0, batch[key])
        with set_recurrent_mode(True):
            assert_close(module(batch)["feature"], torch.stack(outputs, 1), 1e-6)
