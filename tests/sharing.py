"""Script: one of several processes that share a training; `tests/test_recipe_ranks.py` starts them.

    python tests/sharing.py JOB STORE RANK COUNT FOLDER

A job trains in the folder of its name. The one called "whole" then also learns from a batch, is refused the
run of one process, and trains in the environment `Rows`: that has no random numbers, and actions are drawn
without any, so that it does not matter which process has which row.
"""

import dataclasses
import functools
import sys
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import distributed
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import IndependentNormal

import tasks
from torchrl_sym.recipes import PPOConfig, train
from torchrl_sym.recipes.learner import Learner
from torchrl_sym.recipes.networks import make_networks

MAKE_ENV = functools.partial(tasks.make_env, "cartpole", num_threads=1)
CONFIG = PPOConfig(iterations=3, num_envs=8, horizon=12, epochs=2, minibatches=3)
NORMALIZED = {"normalize_observations": True, "normalize_rewards": True, "mirror_coeff": 0.1}
SHORT = PPOConfig(iterations=25, num_envs=8, horizon=8, epochs=1, minibatches=1, checkpoint_interval=3)


class Rows(EnvBase):
    """Points that are pushed towards zero: rows of a whole, from one of them on."""

    def __init__(self, first: int, count: int) -> None:
        super().__init__(batch_size=[count])
        rows = (count,)
        self.observation_spec = Composite(observation=Unbounded((*rows, 3)), shape=rows)
        self.action_spec, self.reward_spec = Unbounded((*rows, 1)), Unbounded((*rows, 1))
        flags = {
            flag: Binary(1, (*rows, 1), dtype=torch.bool) for flag in ("done", "terminated", "truncated")
        }
        self.done_spec = Composite(**flags, shape=rows)
        self.row = torch.arange(first, first + count)[:, None]
        self.step_count = torch.zeros_like(self.row)

    def _set_seed(self, seed):
        pass

    def _reset(self, tensordict=None, **kwargs):
        begun = torch.ones_like(self.row, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict:
            begun = tensordict["_reset"].reshape(begun.shape)
        start = torch.sin(self.row + torch.tensor([1.0, 2.0, 3.0]))
        self.x = start if not hasattr(self, "x") else torch.where(begun, start, self.x)
        self.step_count = self.step_count.masked_fill(begun, 0)
        return self._output(torch.zeros_like(begun))

    def _step(self, tensordict):
        self.step_count = self.step_count + 1
        action = tensordict["action"]
        self.x = 0.9 * self.x + 0.3 * action * torch.tensor([1.0, 0.5, 0.2])
        over = self.step_count >= 4 + self.row % 3
        return self._output(over, reward=-self.x.square().sum(-1, keepdim=True) - 0.1 * action.square())

    def _output(self, over, **more):
        flags = {"done": over, "terminated": over & (self.row % 2 == 0), "truncated": over.clone()}
        return TensorDict(observation=self.x, **flags, **more, batch_size=self.batch_size)


def make_rows(*, num_envs, seed):
    rank = distributed.get_rank() if distributed.is_initialized() else 0
    return Rows(rank * num_envs, num_envs)


def draw_without_chance():
    def sample(self, *shape):
        return self.mean + self.stddev * torch.sin(3 * self.mean)

    IndependentNormal.sample = IndependentNormal.rsample = sample


def updates(folder):
    """Gradients of all updates from a batch that lies in the folder, and what is reported."""
    torch.manual_seed(0)
    env = MAKE_ENV(num_envs=1, seed=0)
    learner = Learner(CONFIG, *make_networks(CONFIG, env, env.symmetry), env.symmetry)
    ranks, update = learner.ranks, learner.update
    data = torch.load(folder / "data.pt", weights_only=False)
    data = ranks.gather(data.chunk(ranks.count)[ranks.index])
    gradients = []

    def watched(minibatch):
        report = update(minibatch)
        gradients.append(torch.cat([parameter.grad.flatten() for parameter in learner.parameters]))
        return report

    learner.update = watched
    torch.manual_seed(1 + ranks.index)  # the order of rows is that of the first
    report = learner.learn(data)
    return {"gradients": torch.stack(gradients), "report": report}


def curve():
    """Metrics of a training in which every process has its rows of one whole."""
    draw_without_chance()
    symmetry = MAKE_ENV(num_envs=1, seed=0).symmetry
    return list(train(dataclasses.replace(CONFIG, **NORMALIZED), make_rows, symmetry))


def refusal(folder):
    """What is said to processes that would continue the run of one."""
    try:
        train(SHORT, MAKE_ENV, MAKE_ENV(num_envs=1).symmetry, folder=folder)
    except ValueError as error:
        return str(error)


def main(job: str, store: str, rank: int, count: int, folder: Path) -> None:
    torch.set_num_threads(1)
    distributed.init_process_group("gloo", f"file://{folder / store}", rank=rank, world_size=count)
    train(SHORT, MAKE_ENV, MAKE_ENV(num_envs=1).symmetry, folder=folder / job).run()
    if job == "whole":
        found = {"updates": updates(folder), "refusal": refusal(folder / "alone"), "curve": curve()}
        torch.save(found, folder / f"found_{rank}.pt")
    distributed.destroy_process_group()


if __name__ == "__main__":
    main(*sys.argv[1:3], *map(int, sys.argv[3:5]), Path(sys.argv[5]))
