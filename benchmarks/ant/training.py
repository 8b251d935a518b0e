"""One run of the off-policy study: SAC or TD3 on the Ant, with plain or with symmetric replay.

The seeds of a run are trained side by side: their networks are stacked, one matrix product serves all of
them, and TorchRL's loss sees a batch (seeds, rows). Parameters, data, and thus gradients and Adam's steps
are each seed's own, as if it were alone (tests/test_off_policy.py), but the constant cost of a loss call,
which is the larger part of it for networks of this size, is paid once. This is why SAC's temperature is
fixed: a learned one would be the only thing that seeds share.

Symmetric replay maps each sampled row by one random element of the group. Both arms therefore update as
often, with as many rows, at the same cost.
"""

from __future__ import annotations

import csv
import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded, LazyTensorStorage, ReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import LossModule, SACLoss, SoftUpdate, TD3Loss

from ant.world import ant_symmetry, evaluate, make_env, make_envs
from torchrl_sym import SymmetryAugment


@dataclass(frozen=True)
class Setting:
    """A run of several seeds; the defaults are the study's."""

    algorithm: Literal["sac", "td3"]
    arm: Literal["plain", "symmetric"]
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    frames: int = 20_000
    """Environment steps of a seed."""
    envs: int = 8
    """Environments of a seed, which step together."""
    updates: int = 4
    """Gradient steps for each step of the environments."""
    rows: int = 128
    """Rows of a seed per gradient step."""
    random_frames: int = 2_000
    """Frames of uniformly random actions, before the first gradient step."""
    cells: int = 128
    """Width of the two hidden layers of every network."""
    critic_rate: float = 1e-3
    """Learning rate of the two critics."""
    actor_rate: float = 5e-4
    """Learning rate of the actor."""
    gamma: float = 0.95
    tau: float = 0.02
    """Share of the critics (and TD3's actor) that their targets take over per gradient step."""
    alpha: float = 0.05
    """SAC's temperature."""
    noise: float = 0.3
    """Deviation of what TD3 adds to its actions to explore."""
    effort: float = 0.1
    """Weight of a penalty on what TD3's actor feeds its tanh, squared, without which actions saturate."""
    delay: int = 2
    """TD3's gradient steps of the critics per step of the actor."""
    evaluations: int = 10
    """Evaluations, evenly spaced, the last one at the end."""
    episodes: int = 4
    """Episodes of a seed per evaluation."""

    @property
    def name(self) -> str:
        return f"{self.algorithm}-{self.arm}"


class Stacked(nn.Module):
    """Independent networks of two hidden layers, one per seed: (seeds, rows, n) to (seeds, rows, m)."""

    def __init__(self, seeds: int, inputs: int, outputs: int, cells: int) -> None:
        super().__init__()
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for size, following in itertools.pairwise([inputs, cells, cells, outputs]):
            layers = [nn.Linear(size, following) for _ in range(seeds)]
            self.weights.append(torch.stack([layer.weight.detach().T for layer in layers]))
            self.biases.append(torch.stack([layer.bias.detach()[None] for layer in layers]))

    def forward(self, *inputs: Tensor) -> Tensor:
        x = torch.cat(inputs, -1)
        for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = (x.relu() if number else x) @ weight + bias
        return x


def make_loss(setting: Setting, observations: int, actions: int) -> LossModule:
    """TorchRL's loss around the stacked networks."""
    size = {"seeds": len(setting.seeds), "cells": setting.cells}
    critic = Stacked(inputs=observations + actions, outputs=1, **size)
    qvalue = ValueOperator(critic, in_keys=["observation", "action"])
    shared = {"loss_function": "l2", "num_qvalue_nets": 2, "action_spec": Bounded(-1.0, 1.0, (actions,))}
    if setting.algorithm == "sac":
        body = nn.Sequential(
            Stacked(inputs=observations, outputs=2 * actions, **size), NormalParamExtractor()
        )
        head = TensorDictModule(body, in_keys=["observation"], out_keys=["loc", "scale"])
        actor = ProbabilisticActor(head, in_keys=["loc", "scale"], distribution_class=TanhNormal)
        loss: LossModule = SACLoss(actor, qvalue, alpha_init=setting.alpha, fixed_alpha=True, **shared)
    else:
        body = nn.Sequential(Stacked(inputs=observations, outputs=actions, **size), nn.Tanh())
        actor = TensorDictModule(body, in_keys=["observation"], out_keys=["action"])
        loss = TD3Loss(actor, qvalue, delay_actor=True, **shared)
    loss.make_value_estimator(gamma=setting.gamma)
    return loss


class Learner:
    """Networks, their loss and their optimizer: acts, and learns from batches (seeds, rows)."""

    def __init__(self, setting: Setting, observations: int, actions: int) -> None:
        self.setting, self.steps = setting, 0
        self.loss = make_loss(setting, observations, actions)
        self.target = SoftUpdate(self.loss, tau=setting.tau)
        rates = {"actor_network": setting.actor_rate, "qvalue_network": setting.critic_rate}
        groups = [
            {"params": list(getattr(self.loss, f"{name}_params").values(True, True)), "lr": rate}
            for name, rate in rates.items()
        ]
        self.optimizer = torch.optim.Adam(groups, fused=True)

    @torch.no_grad()
    def act(self, observation: Tensor, *, explore: bool = False) -> Tensor:
        """Actions ``(seeds, n, 8)`` for observations ``(seeds, n, 27)``."""
        kind = ExplorationType.RANDOM if explore else ExplorationType.DETERMINISTIC
        with set_exploration_type(kind), self.loss.actor_network_params.to_module(self.loss.actor_network):
            td = TensorDict(observation=observation, batch_size=observation.shape[:-1])
            action = self.loss.actor_network(td)["action"]
        if explore and self.setting.algorithm == "td3":
            action = action + self.setting.noise * torch.randn_like(action)
        return action.clamp(-1.0, 1.0)

    def update(self, batch: TensorDict) -> None:
        """One gradient step."""
        self.steps += 1
        if self.setting.algorithm == "sac":
            out = self.loss(batch)
            total = out["loss_qvalue"] + out["loss_actor"]
        else:
            total = self.loss.value_loss(batch)[0]
            if self.steps % self.setting.delay == 0:
                total = total + self.loss.actor_loss(batch)[0] + self.effort(batch["observation"])
        # a mean over seeds, whose gradients Adam takes for what they are at any scale
        total.backward()
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.target.step()

    def effort(self, observation: Tensor) -> Tensor:
        """TD3's penalty. Once a tanh is saturated, no gradient of the critic leads out of it."""
        body = self.loss.actor_network.module
        with self.loss.actor_network_params.to_module(self.loss.actor_network):
            return self.setting.effort * body[0](observation).square().mean()


def train(setting: Setting) -> Iterator[list[dict[str, float]]]:
    """Rows of the evaluation curves, one per seed, at every evaluation."""
    seeds, n = setting.seeds, setting.envs
    torch.manual_seed(seeds[0])
    symmetry = ant_symmetry(make_env().unwrapped.model)
    actions = symmetry["action"].dim
    learner = Learner(setting, symmetry["observation"].dim, actions)
    envs, evaluated = make_envs(n * len(seeds)), make_envs(setting.episodes * len(seeds))
    buffer = ReplayBuffer(storage=LazyTensorStorage(setting.frames), batch_size=setting.rows)
    augment = SymmetryAugment(symmetry, elements="random")

    def rows(array: np.ndarray) -> Tensor:
        """(seeds * envs, ...) as (envs, seeds, ...): a record of the buffer has one row of each seed."""
        x = torch.as_tensor(array, dtype=None if array.dtype == bool else torch.float32)
        return x.reshape(len(seeds), n, -1).transpose(0, 1)

    started, times = time.process_time(), np.linspace(0, setting.frames, setting.evaluations + 1)[1:]
    observation, _ = envs.reset(seed=[100 * seed + k for seed in seeds for k in range(n)])
    for frames in range(n, setting.frames + 1, n):
        seen = rows(observation)
        if frames <= setting.random_frames:
            action = 2.0 * torch.rand(n, len(seeds), actions) - 1.0
        else:
            action = learner.act(seen.transpose(0, 1), explore=True).transpose(0, 1)
        flat = action.transpose(0, 1).flatten(0, 1).numpy()
        observation, reward, terminated, truncated, info = envs.step(flat)
        done = terminated | truncated
        following = np.stack(info["final_obs"]) if done.all() else observation  # all end together
        after = {"observation": following, "reward": reward, "terminated": terminated, "done": done}
        batch_size = [n, len(seeds)]
        following = TensorDict({key: rows(array) for key, array in after.items()}, batch_size=batch_size)
        buffer.extend(TensorDict(observation=seen, action=action, next=following, batch_size=batch_size))

        for _ in range(setting.updates if frames > setting.random_frames else 0):
            batch = buffer.sample()
            if setting.arm == "symmetric":
                batch = augment(batch)  # which draws an element for each row of each seed
            learner.update(batch.transpose(0, 1))
        if frames >= times[0]:
            times = times[1:]
            spent = {"frames": frames, "updates": learner.steps, "seconds": time.process_time() - started}
            measured = evaluate(learner.act, evaluated, symmetry, seeds)
            yield [
                {"algorithm": setting.algorithm, "arm": setting.arm, "seed": seed}
                | spent
                | {name: float(values[k]) for name, values in measured.items()}
                for k, seed in enumerate(seeds)
            ]


def write(rows: list[dict], path: Path) -> None:
    """A table of rows, which is there as a whole or not at all."""
    growing = path.with_suffix(".partial")
    with growing.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        for row in rows:
            writer.writerow({key: f"{x:.6g}" if isinstance(x, float) else x for key, x in row.items()})
    growing.replace(path)
