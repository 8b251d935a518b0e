"""Watch a policy, or random actions, on all equivalent goals at once; no display is needed.

    python examples/watch.py anymal_push --checkpoint runs/push --out push.gif

Episodes are paired: every goal starts from the image of one and the same state. Without a checkpoint the
actions are random and mirrored too, so the pictures are exact mirror images: the symmetry of the task.
With one, differences are the policy's own.

The suffix of --out decides: .gif or .mp4 (pip install imageio imageio-ffmpeg) a film, goals side by
side, .png a strip of key frames, one row per goal. With --overlay, a .png of all paths from above instead.
"""

import functools
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

if sys.platform == "linux" and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")  # read when mujoco is imported

import torch
import tyro
from torchrl.envs.utils import ExplorationType

import tasks
from tasks.paths import overlay
from tasks.rendering import record, render, save, sheet
from torchrl_sym.recipes import load_actor

FPS = 25.0


@dataclass
class Arguments:
    """Render one rollout per equivalent goal."""

    task: tyro.conf.Positional[Literal[tasks.ALL_TASKS]]  # type: ignore[valid-type]
    """What to watch."""
    checkpoint: Path | None = None
    """Folder of a training run; random actions when left out."""
    out: Path = Path("watch.gif")
    """Film (.gif, .mp4) or picture (.png)."""
    goals: tuple[str, ...] = ("all",)
    """Names of goals, or all."""
    seconds: float | None = None
    """Length of the rollout; one episode when left out."""
    seed: int = 0
    """Of the start state and of random actions."""
    stochastic: bool = False
    """Sample the policy's actions."""
    task_kwargs: dict[str, int | float | bool | str] = field(default_factory=dict)
    """Arguments of the task (docs/tasks.md), such as: yaw 3.14 difficulty 2."""
    overlay: bool = False
    """Draw the paths of everything that moves freely from above, instead of a film."""
    frames: int = 5
    """Key frames per goal of a .png."""
    width: int = 320
    """Of one picture, pixels; the height is three quarters of it."""


class MirroredNoise:
    """Slowly varying random actions, each goal's the image of the first goal's."""

    def __init__(self, env, elements, seed):
        self.generator = torch.Generator().manual_seed(seed)
        self.transform, self.elements = env.symmetry["action"], torch.tensor(elements)
        self.action = torch.zeros(1, env.action_spec.shape[-1])

    def __call__(self, tensordict):
        noise = torch.randn(self.action.shape, generator=self.generator)
        self.action = 0.95 * self.action + 0.1 * noise
        action = self.transform(self.action.expand(len(self.elements), -1), self.elements)
        return tensordict.set("action", action)


def rollout(arguments):
    """The task, the group elements of the goals, and the states of one rollout of each."""
    make_env = functools.partial(tasks.make_env, arguments.task, **arguments.task_kwargs)
    task = make_env(num_envs=1).task
    names = task.goal_names if arguments.goals == ("all",) else arguments.goals
    unknown = set(names) - set(task.goal_names)
    if unknown:
        raise SystemExit(f"expected goals among {task.goal_names}, got {sorted(unknown)}")
    elements = [task.goal_names.index(name) for name in names]
    env = make_env(num_envs=len(elements), num_threads=1, seed=0)
    start = task.sample_goal_states(1, torch.Generator().manual_seed(arguments.seed), elements)
    torch.manual_seed(arguments.seed)
    if arguments.checkpoint is None:
        policy = MirroredNoise(env, elements, arguments.seed)
    else:
        policy = load_actor(arguments.checkpoint, env, env.symmetry)
    steps = round((arguments.seconds or task.episode_seconds) / task.control_timestep)
    exploration = ExplorationType.RANDOM if arguments.stochastic else ExplorationType.DETERMINISTIC
    return task, elements, record(env, policy, start, steps=steps, exploration=exploration)


def main(arguments: Arguments) -> None:
    torch.set_num_threads(1)
    task, elements, states = rollout(arguments)
    names = [task.goal_names[g] for g in elements]
    size = {"width": arguments.width, "height": arguments.width * 3 // 4}
    if arguments.overlay:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        overlay(task, states, elements).savefig(arguments.out, dpi=110)
    elif arguments.out.suffix == ".png":
        chosen = torch.linspace(0, len(states) - 1, arguments.frames).round().int().tolist()
        images = render(task, [states[i] for i in chosen], **size)
        times = [f"{i * task.control_timestep:.1f} s" for i in chosen]
        captions = [[f"{name}, {time}" for time in times] for name in names]
        rows = [[image[row] for image in images] for row in range(len(names))]
        save(arguments.out, [sheet(rows, captions)])
    else:
        stride = max(1, round(1 / (FPS * task.control_timestep)))
        images = render(task, states[::stride], **size)
        fps = 1 / (stride * task.control_timestep)
        save(arguments.out, [sheet([list(image)], [names]) for image in images], fps)
    print(f"{len(states) - 1} steps of {', '.join(names)}: {arguments.out}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
