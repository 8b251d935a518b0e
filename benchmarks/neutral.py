"""Starts that are their own mirror image: who freezes there, and what breaks the tie?

    python benchmarks/neutral.py results/paper-push/policies/anymal_push   # a folder of policies by method

At a state s with L_g[s] = s, an equivariant policy's mean action is its own image too, so that a symmetric
simulation stays symmetric for ever: a robot that has to walk, with its goal straight ahead, can only hop
(the paper, Sec. III). Unless rounding breaks the tie, or noise. Of many drawn starts, those nearest to
their own image are made neutral (the mean with the image), and every policy plays the neutral start and the
one that was drawn.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
import tyro
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from comparison.environments import environment, task_setting
from comparison.files import write_whole
from comparison.markdown import markdown
from tasks.base import Task
from tasks.environment import BatchedEnv
from tasks.state import State
from torchrl_sym.recipes import load_actor

mj: Any = mujoco  # its compiled modules have no type stubs
SEED = 1000  # of the starts, as in evaluation
DRAWN = 20_000  # starts of which the nearest to their own image are taken
BROKEN = 0.05  # rad, m: a joint further than that from where its image is has left the symmetric states
STARTS = ("drawn", "neutral")
KINDS = {"mean actions": ExplorationType.DETERMINISTIC, "sampled": ExplorationType.RANDOM}


@dataclass
class Arguments:
    """Play neutral starts, and the starts that they were made of."""

    policies: tyro.conf.Positional[Path]
    """A folder with one per method, or per method and seed, each with a checkpoint."""
    task: str = "anymal_push"
    """What they were trained on."""
    element: str = "reflect-y"
    """The element under which starts are their own image."""
    episodes: int = 200
    """Starts of either kind."""
    output: Path | None = None
    """Where the numbers go (JSON)."""


def main(arguments: Arguments) -> int:
    how = next(iter(task_setting(arguments.task).evaluations.values()))
    env = environment(arguments.task)(num_envs=1, seed=SEED, **how)
    starts = dict(zip(STARTS, near_starts(env.task, arguments.episodes, arguments.element), strict=True))
    rows: list[dict[str, Any]] = []
    for folder in sorted(p.parent for p in arguments.policies.glob("**/checkpoint.pt")):
        actor = load_actor(folder, env, env.symmetry)
        method = str(folder.relative_to(arguments.policies))
        for kind, exploration in KINDS.items():
            for name, start in starts.items():
                played = play(env.task, actor, start, exploration, arguments.element)
                rows.append({"method": method, "actions": kind, "start": name, **played.figures()})
    print(table(rows))
    if arguments.output is not None:
        write_whole(arguments.output, json.dumps(rows, indent=1) + "\n")
    return 0


def near_starts(task: Task, episodes: int, element: str) -> tuple[State, State]:
    """Drawn starts that are nearest to their own image, and the same, made to be it."""
    drawn = task.sample_goal_state(DRAWN, torch.Generator().manual_seed(SEED))
    image = task.transform_state(drawn, element)
    nearest = differences(task, drawn.qpos, image.qpos).square().sum(-1).argsort()[:episodes]
    chosen = drawn.rows(nearest)
    return chosen, neutral(task, chosen, element)


def neutral(task: Task, state: State, element: str) -> State:
    """The mean of every row with its image, quaternions normalised: a state that is its own image."""
    image = task.transform_state(state, element)

    def mean(a: Tensor | None, b: Tensor | None) -> Any:
        return None if a is None or b is None else (a + b) / 2

    gap = differences(task, state.qpos, image.qpos)
    qpos = state.qpos.clone()
    for row, half in zip(qpos.numpy(), gap.numpy() / 2, strict=True):
        mj.mj_integratePos(task.model, row, half, 1.0)
    return State(
        qpos=qpos,
        qvel=mean(state.qvel, image.qvel),
        mocap_pos=mean(state.mocap_pos, image.mocap_pos),
        mocap_quat=state.mocap_quat,
        time=state.time.clone(),
        variables={name: mean(x, image.variables[name]) for name, x in state.variables.items()},
    )


def differences(task: Task, a: Tensor, b: Tensor) -> Tensor:
    """From one configuration to another, ``(n, nv)``: m and rad, whatever the joints are."""
    gap = np.zeros((len(a), task.model.nv))
    for row, x, y in zip(gap, a.numpy(), b.numpy(), strict=True):
        mj.mj_differentiatePos(task.model, row, 1.0, x, y)
    return torch.from_numpy(gap)


@dataclass
class Played:
    """What became of the episodes of one start, ``(n,)`` each."""

    returns: Tensor
    success: Tensor
    broken: Tensor  # s, when the state left its image; NaN where it never did

    def figures(self) -> dict[str, float]:
        """Means; the median time of leaving, infinite if most never do."""
        times = self.broken.nan_to_num(math.inf).median()
        return {
            "return": float(self.returns.mean()),
            "success": float(self.success.double().mean()),
            "symmetric_seconds": float(times),
            "never_broken": float(self.broken.isnan().double().mean()),
        }


def play(
    task: Task,
    actor: ProbabilisticTensorDictSequential,
    start: State,
    exploration: ExplorationType,
    element: str,
) -> Played:
    """One episode of every start."""
    env = BatchedEnv(task, len(start), num_threads=1, seed=SEED)
    torch.manual_seed(SEED)
    with torch.no_grad(), set_exploration_type(exploration):
        now = env.reset_to(start)
        running = ~now["done"].squeeze(-1)
        returns = torch.zeros(len(start), dtype=torch.float64)
        success = torch.zeros_like(running)
        broken = torch.full_like(returns, math.nan)
        while bool(running.any()):
            now = env.step(actor(now))
            returns += now["next", "reward"].squeeze(-1).double() * running
            image = task.transform_state(env.state, element)
            left = differences(task, env.state.qpos, image.qpos).abs().amax(-1) > BROKEN
            broken = torch.where(running & left & broken.isnan(), env.state.time, broken)
            ended = running & now["next", "done"].squeeze(-1)
            reached = task.success(env.state)
            success |= ended & (reached if reached is not None else False)
            running &= ~ended
            now = step_mdp(now)
    return Played(returns, success, broken)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """As Markdown: success from drawn and neutral starts, and how long neutral ones stay symmetric."""
    found = {(row["method"], row["actions"], row["start"]): row for row in rows}
    body = []
    for method, actions in dict.fromkeys((row["method"], row["actions"]) for row in rows):
        drawn, own = (found[method, actions, start] for start in STARTS)
        cells = [f"{drawn['success']:.0%}", f"{own['success']:.0%}", f"{drawn['return']:.1f}"]
        cells += [f"{own['return']:.1f}", f"{own['symmetric_seconds']:.1f}", f"{own['never_broken']:.0%}"]
        body.append([method, actions, *cells])
    head = [
        "method",
        "actions",
        "success, drawn",
        "neutral",
        "return, drawn",
        "neutral",
        "symmetric for [s]",
    ]
    return markdown([*head, "to the end"], body)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments)))
