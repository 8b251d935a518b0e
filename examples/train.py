"""Train a task from the command line: `python examples/train.py --help`.

    python examples/train.py --task cartpole --folder runs/cartpole --config.augmentation all

The run can be killed and started again: it continues where its last checkpoint was.
"""

import functools
from dataclasses import dataclass, field
from typing import Literal

import torch
import tyro

import tasks
from tasks.evaluation import evaluate
from torchrl_sym.recipes import PPOConfig, load_actor, train


@dataclass
class Arguments:
    """Train PPO with symmetry on one of the tasks, then evaluate every equivalent goal."""

    task: Literal[tasks.ALL_TASKS] = "cartpole"  # type: ignore[valid-type]
    """What to train."""
    folder: str = "runs/train"
    """Where metrics.csv and checkpoint.pt go."""
    logger: Literal["csv", "tensorboard", "wandb"] = "csv"
    """Where metrics go besides metrics.csv."""
    threads: int = 1
    """Physics threads; networks use one."""
    config: PPOConfig = field(default_factory=PPOConfig)
    """Hyper-parameters."""


def main(arguments: Arguments) -> None:
    torch.set_num_threads(1)
    make_env = functools.partial(tasks.make_env, arguments.task, num_threads=arguments.threads)
    env = make_env(num_envs=1, seed=0)
    for _ in train(
        arguments.config,
        make_env,
        env.symmetry,
        folder=arguments.folder,
        logger=arguments.logger,
        progress=True,
    ):
        pass
    result = evaluate(env, load_actor(arguments.folder, env, env.symmetry))
    print(f"mean return {result.mean:.3f}, variation {result.variation:.3f}")
    for goal, value in result.goal_means.items():
        print(f"  {goal:12s} {value:.3f}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
