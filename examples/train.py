"""Train a task from the command line, with its own settings: `python examples/train.py --help`.

    python examples/train.py anymal_push --folder runs/push
    python examples/train.py anymal_climb --folder runs/low --task-kwargs height 0.2 phase C
    torchrun --nproc-per-node=4 examples/train.py anymal_push --folder runs/push

The run can be killed and started again: it continues where its last checkpoint was. Stages are trained in
order, in `stage_0`, `stage_1`, ... of the folder; what is changed on the command line is changed in all of
them. The processes of `torchrun` share one training, whose settings are those of the whole: each has its
part of the environments, and with `--config.device cuda` a card of its own. As many can continue it.
"""

import dataclasses
import functools
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
import tyro
from torch import distributed

import tasks
from tasks.evaluation import evaluate
from tasks.settings import SETTINGS
from torchrl_sym.recipes import PPOConfig, Stage, load_actor, train_stages


@dataclass
class Arguments:
    """Train PPO with symmetry on one of the tasks, then evaluate every equivalent goal."""

    task: tyro.conf.Fixed[str]
    """What to train."""
    config: PPOConfig
    """Hyper-parameters."""
    task_kwargs: dict[str, int | float | bool | str] = field(default_factory=dict)
    """Arguments of the task (docs/tasks.md), such as: height 0.2 phase C. Evaluations keep theirs."""
    folder: Path = Path("runs/train")
    """Where metrics.csv and checkpoint.pt go."""
    logger: Literal["csv", "tensorboard", "wandb"] = "csv"
    """Where metrics go besides metrics.csv."""
    episodes: int = 500
    """Evaluation episodes per goal."""
    threads: int = 1
    """Physics threads of a process; networks use one."""


def join(device: str) -> bool:
    """Join the other processes of `torchrun`, if it started this one; whether this is the first."""
    if "LOCAL_RANK" not in os.environ:
        return True
    backend = "gloo"
    if torch.device(device).type == "cuda":
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
        backend = "cpu:gloo,cuda:nccl"
    distributed.init_process_group(backend)
    return distributed.get_rank() == 0


def main(arguments: Arguments) -> None:
    torch.set_num_threads(1)
    first = join(arguments.config.device)
    setting = SETTINGS[arguments.task]
    before, asked = dataclasses.asdict(setting.config), dataclasses.asdict(arguments.config)
    changes = {name: value for name, value in asked.items() if value != before[name]}
    kwargs = arguments.task_kwargs
    make_env = functools.partial(tasks.make_env, arguments.task, num_threads=arguments.threads)
    stages = [Stage(stage.config, stage.task | kwargs) for stage in setting.replace(**changes).stages]
    symmetry = make_env(num_envs=1, seed=0, **stages[0].task).symmetry
    where = {"folder": arguments.folder, "logger": arguments.logger}
    train_stages(stages, make_env, symmetry, **where, progress=True).run()
    if distributed.is_initialized():
        distributed.destroy_process_group()
    if not first:
        return

    for what, evaluated in setting.evaluations.items():
        env = make_env(num_envs=1, seed=0, **kwargs | evaluated)
        result = evaluate(env, load_actor(arguments.folder, env, env.symmetry), arguments.episodes)
        print(f"{what}: mean return {result.mean:.3f}, variation {result.variation:.3f}")
        for goal, value in result.goal_means.items():
            success = result.goal_successes.get(goal)
            print(f"  {goal:12s} {value:.3f}" + (f", success {success:.1%}" if success is not None else ""))


if __name__ == "__main__":
    choices = {
        name: (f"train {name}", Arguments(name, setting.config)) for name, setting in SETTINGS.items()
    }
    main(tyro.extras.overridable_config_cli(choices))
