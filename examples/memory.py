"""A policy with memory, trained on samples and their mirror images.

A cart on a frictionless rail is to be brought to rest at the origin, but its velocity is hidden. A force
that depends on the position alone conserves energy, like a spring, and never brings the cart to rest; a
recurrent actor can remember how fast it moves. The critic, which is needed in training only, sees all.

A mirror image is exact if its memory is rebuilt from the beginning of an episode. Hence the three lines
that are new in this loop, marked with *memory*: the memory is declared as invariant, which says that copies
begin from zero memory; every batch begins with a reset; the buffer holds whole sequences.

    python examples/memory.py --seeds 5
"""

from dataclasses import dataclass

import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import (
    Bounded,
    Composite,
    LazyTensorStorage,
    SamplerWithoutReplacement,
    TensorDictReplayBuffer,
    Unbounded,
)
from torchrl.envs import EnvBase, InitTracker, StepCounter, TransformedEnv
from torchrl.modules import MLP, GRUModule, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives.value import GAE

from torchrl_sym import PointGroup, SymmetricClipPPOLoss, Symmetry
from torchrl_sym.representations import invariant, pseudoscalar

GROUP = PointGroup.reflection("x")
TIMESTEP = 0.1  # s
MAX_ACCELERATION = 2.0  # m/s^2, at full action
# Where carts start: distance from the origin (m) on either side, and speed (m/s) in either direction.
START_DISTANCE, START_SPEED = (0.5, 1.5), 1.0


class Rail(EnvBase):
    """Bring a cart to rest at the origin; the reward is ``-|x| dt`` per step, in m s.

    Args:
        num_envs: number of carts.
        seed: seed of their starts.
    """

    def __init__(self, num_envs: int, seed: int) -> None:
        super().__init__(batch_size=[num_envs])
        self.observation_spec = Composite(
            position=Unbounded((num_envs, 1)), state=Unbounded((num_envs, 2)), shape=(num_envs,)
        )
        self.action_spec = Bounded(-1.0, 1.0, (num_envs, 1))
        self.reward_spec = Unbounded((num_envs, 1))
        self.generator = torch.Generator().manual_seed(seed)

    def _observation(self, state: torch.Tensor) -> dict[str, torch.Tensor]:
        return {"position": state[:, :1], "state": state}

    def _reset(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        low, high = START_DISTANCE
        distance, side, speed = torch.rand(3, *self.batch_size, generator=self.generator)
        x = (low + (high - low) * distance) * torch.where(side < 0.5, -1.0, 1.0)
        start = torch.stack([x, START_SPEED * (2 * speed - 1)], -1)
        return TensorDict(self._observation(start), batch_size=self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        x, v = tensordict["state"].split(1, -1)
        v = v + tensordict["action"].clamp(-1.0, 1.0) * MAX_ACCELERATION * TIMESTEP
        x = x + v * TIMESTEP
        done = torch.zeros_like(x, dtype=torch.bool)
        entries = self._observation(torch.cat([x, v], -1))
        entries |= {"reward": -x.abs() * TIMESTEP, "done": done, "terminated": done}
        return TensorDict(entries, batch_size=self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed or 0)


@dataclass
class Arguments:
    """Train a recurrent and a feed-forward actor that do not see the cart's velocity."""

    seeds: int = 2
    """Runs of each."""
    iterations: int = 60
    """Collect-and-learn rounds, of one episode per cart."""
    num_envs: int = 64
    """Carts."""
    steps: int = 60
    """Steps of an episode, of 0.1 s."""
    units: int = 32
    """Size of the memory, or of the feed-forward actor's hidden layers."""


def make_actor(features: nn.Module, size: int) -> ProbabilisticActor:
    """A Gaussian policy on the output of a network that reads the position."""
    head = nn.Sequential(nn.Linear(size, 1), AddStateIndependentNormalScale(1))
    return ProbabilisticActor(
        TensorDictSequential(features, TensorDictModule(head, ["feature"], ["loc", "scale"])),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )


def train(arguments: Arguments, recurrent: bool, seed: int) -> float:
    """Mean return of the last episodes."""
    torch.manual_seed(seed)
    units, envs, steps = arguments.units, arguments.num_envs, arguments.steps
    env = TransformedEnv(Rail(envs, seed), StepCounter(steps)).append_transform(InitTracker())
    sign = pseudoscalar(GROUP)
    entries = {"position": sign, "state": sign * 2, "action": sign}
    if recurrent:
        features = GRUModule(1, units, in_key="position", out_key="feature")
        env.append_transform(features.make_tensordict_primer())
        entries["recurrent_state"] = invariant(GROUP, units)  # memory
    else:
        features = TensorDictModule(MLP(1, units, num_cells=[units]), ["position"], ["feature"])
    actor = make_actor(features, units)
    critic = ValueOperator(MLP(2, 1, num_cells=[32, 32]), in_keys=["state"])

    gae = GAE(gamma=0.98, lmbda=0.95, value_network=critic)
    loss = SymmetricClipPPOLoss(
        actor, critic, symmetry=Symmetry(GROUP, entries), normalize_advantage=True, entropy_coeff=0.001
    )
    parameters = [*actor.parameters(), *critic.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=3e-3)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(envs),  # memory: one item is a sequence
        sampler=SamplerWithoutReplacement(),
        batch_size=envs // 4,
    )
    frames = envs * steps
    collector = Collector(
        env,
        actor,
        frames_per_batch=frames,
        total_frames=frames * arguments.iterations,
        reset_at_each_iter=True,  # memory
    )
    returns: list[float] = []
    kl = kl_mirrored = 0.0
    for data in collector:
        with torch.no_grad():
            gae(data)
        buffer.extend(data)
        for _ in range(4):
            for sequences in buffer:
                out = loss(sequences)
                optimizer.zero_grad()
                (out["loss_objective"] + out["loss_critic"] + out["loss_entropy"]).backward()
                nn.utils.clip_grad_norm_(parameters, 1.0)
                optimizer.step()
                kl, kl_mirrored = out["kl_approx_sym"].tolist()
        returns.append(float(data["next", "reward"].sum(1).mean()))
    collector.shutdown()
    name = "recurrent" if recurrent else "feed-forward"
    print(f"{name}, seed {seed}: return {returns[0]:.2f}, after training {returns[-1]:.2f}", end="; ")
    print(f"KL of samples {kl:.4f}, of mirror images {kl_mirrored:.4f}", flush=True)
    return returns[-1]


def main(arguments: Arguments) -> None:
    torch.set_num_threads(1)
    mean = {
        recurrent: sum(train(arguments, recurrent, seed) for seed in range(arguments.seeds))
        / arguments.seeds
        for recurrent in (True, False)
    }
    print(f"mean return with memory {mean[True]:.2f}, without {mean[False]:.2f}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
