"""Recurrent policies for tests, and the batches that a collector or a buffer makes of their episodes.

An equivariant policy is an LSTM or GRU whose memory is two halves that the reflection exchanges, with
weights averaged over the group.
"""

from functools import cache

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    AddStateIndependentNormalScale,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, PrioritizedSampler, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.modules import GRUModule, IndependentNormal, ProbabilisticActor, ValueOperator

import tasks
from torchrl_sym import PointGroup, SymmetricClipPPOLoss, Symmetry
from torchrl_sym.memory import memory_keys
from torchrl_sym.representations import Representation, invariant, permutation, pseudoscalar

GROUP = PointGroup.reflection("x")
SIGN = pseudoscalar(GROUP)
UNITS = 6
HALF = [f"{side}{i}" for side in "ab" for i in range(UNITS // 2)]
SWAP = permutation(GROUP, HALF, {"reflect-x": {n: ("b" if n[0] == "a" else "a") + n[1:] for n in HALF}})
ENVS, EPISODE, MASK = 4, 5, ("collector", "mask")


def make_policy(kind: type = GRUModule, equivariant: bool = False) -> ProbabilisticActor:
    """A Gaussian policy on an LSTM or GRU."""
    torch.manual_seed(0)
    network = kind(3, UNITS, in_key="observation", out_key="feature")
    head = nn.Linear(UNITS, 1)
    if equivariant:
        swap, flip = SWAP.matrices[1].float(), SIGN.matrices[1].float()
        inner = network.gru if kind is GRUModule else network.lstm
        for name, weight in inner.named_parameters():
            gates = weight.data.unflatten(0, (-1, UNITS))
            if name.startswith("bias"):
                image = gates @ swap
            else:
                image = swap @ gates @ (-torch.eye(3) if "ih" in name else swap)
            weight.data = ((gates + image) / 2).flatten(0, 1)
        head.weight.data = (head.weight.data + flip @ head.weight.data @ swap) / 2
        head.bias.data.zero_()
    mean = nn.Sequential(head, AddStateIndependentNormalScale(1))
    return ProbabilisticActor(
        TensorDictSequential(network, TensorDictModule(mean, ["feature"], ["loc", "scale"])),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )


def make_symmetry(policy: TensorDictModuleBase, memory: Representation) -> Symmetry:
    entries = {"observation": SIGN * 3, "action": SIGN}
    return Symmetry(GROUP, entries | dict.fromkeys(memory_keys(policy), memory))


def make_critic() -> ValueOperator:
    torch.manual_seed(1)
    return ValueOperator(nn.Linear(3, 1), in_keys=["observation"])


def make_loss(policy: ProbabilisticActor, equivariant: bool = False, **kwargs) -> SymmetricClipPPOLoss:
    symmetry = make_symmetry(policy, SWAP if equivariant else invariant(GROUP, UNITS))
    return SymmetricClipPPOLoss(policy, make_critic(), symmetry=symmetry, **kwargs)


@cache
def collected(kind: type, equivariant: bool, horizon: int, **settings) -> list[TensorDictBase]:
    """Two batches of a collector, with an advantage of 1."""
    policy = make_policy(kind, equivariant)
    base = tasks.make_env("cartpole", num_envs=ENVS, seed=0, episode_seconds=EPISODE * 0.02)
    env = TransformedEnv(base, InitTracker())
    env.append_transform(policy[0][0].make_tensordict_primer())
    settings = {"frames_per_batch": ENVS * horizon, "total_frames": 2 * ENVS * horizon, **settings}
    torch.manual_seed(2)
    collector = Collector(env, policy, **settings)
    batches = [with_advantage(batch.clone()) for batch in collector]
    collector.shutdown()
    return batches


def with_advantage(batch: TensorDictBase) -> TensorDictBase:
    one = torch.ones(*batch.shape, 1)
    return batch.set("advantage", one).set("value_target", one)


def episodes(kind: type, equivariant: bool) -> TensorDictBase:
    """Batches that begin with a reset, seven steps of episodes of five."""
    return collected(kind, equivariant, 7, reset_at_each_iter=True)[1]


def sliced(kind: type, equivariant: bool, steps: int, **settings) -> TensorDictBase:
    """Slices of whole episodes, or shorter ones from anywhere in them, one after another."""
    data = collected(kind, equivariant, 2 * EPISODE)[0].reshape(-1)
    settings = {"traj_key": ("collector", "traj_ids"), **settings}
    sampler = SliceSampler(slice_len=steps, **settings)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(data)), sampler=sampler)
    buffer.extend(data)
    torch.manual_seed(3)
    return buffer.sample(6 * steps)


def stored(kind: type, equivariant: bool, **settings) -> TensorDictBase:
    """Sequences as the items of a buffer."""
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(ENVS), batch_size=3, **settings)
    buffer.extend(episodes(kind, equivariant))
    return buffer.sample()


def prioritized(kind: type, equivariant: bool) -> TensorDictBase:
    try:
        sampler = PrioritizedSampler(ENVS, alpha=0.7, beta=0.5)
    except RuntimeError as error:  # TorchRL's compiled extension does not load with every torch
        pytest.skip(str(error))
    return stored(kind, equivariant, sampler=sampler)


# batches whose sequences begin where episodes do
EXACT = {
    "reset": episodes,
    "split": lambda *of: collected(*of, 7, reset_at_each_iter=True, split_trajs=True)[1],
    "stored": stored,
    "prioritized": prioritized,
    "slices": lambda *of: sliced(*of, EPISODE),
    "reshaped slices": lambda *of: sliced(*of, EPISODE).reshape(-1, EPISODE),
    "padded slices": lambda *of: sliced(*of, EPISODE + 2, strict_length=False, pad_output=True),
    "first of a collector": lambda *of: collected(*of, 7)[0],
}
# batches with some that continue
CUT = {
    "continued": lambda *of: collected(*of, 7)[1],
    "slices": lambda *of: sliced(*of, 3),
    "reshaped slices": lambda *of: sliced(*of, 3).reshape(-1, 3),
    "without flags": lambda *of: sliced(*of, 3, init_key=None).reshape(-1, 3),
}


def by_hand(policy: ProbabilisticActor, batch: TensorDictBase) -> Tensor:
    """log pi(K a | L history) at every step, the memory rebuilt from each start in a loop over time."""
    out = torch.empty(batch.shape)
    network = policy[0][0]
    for b in range(len(batch)):
        memory: dict = {}
        for t in range(batch.shape[1]):
            if t == 0 or batch["is_init"][b, t]:
                memory = {key: torch.zeros(1, 1, UNITS) for key in memory_keys(policy)}
            step = TensorDict(observation=-batch["observation"][b, t : t + 1], batch_size=[1])
            step.update(memory).set("is_init", torch.zeros(1, 1, dtype=torch.bool))
            with torch.no_grad():
                out[b, t] = policy.get_dist(step).log_prob(-batch["action"][b, t : t + 1])
                memory = {key: network(step.clone())["next", key] for key in memory}
    return out
