"""Pictures of what the policies that a comparison keeps do on equivalent goals.

    python benchmarks/behaviour.py paper-push

* `TASK_paths`: robot and object from above, as run and mapped back onto one goal (the paper's figure of
  ANYmal-Push): what is symmetric leaves a single bundle of paths there.
* `TASK_touches`: which limbs touch the cube, goal by goal (ANYmal-Push).
* `TASK_heights`: on how high a box it climbs, forward and backward (ANYmal-Climb).
* `TASK_frames`: key frames of the first two goals, a row per method and goal.

Episodes are paired: every goal starts from the image of the same states. Drawn for the best seed of each
method, with mean actions. A task of one's own, a module that results name, is imported if `--tasks` names
it too.
"""

import os
import sys
from dataclasses import dataclass
from pathlib import Path

if sys.platform == "linux" and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")  # read when mujoco is imported

import matplotlib.pyplot as plt
import mujoco
import numpy as np
import torch
import tyro

from comparison.environments import environment, task_setting
from comparison.experiments import PRESETS
from comparison.methods import Method
from comparison.options import at_least_one, different
from comparison.records import policy_folder
from comparison.study import Study, read
from plot import color
from tasks import ALL_TASKS
from tasks.anymal import LEGS
from tasks.base import Task, create
from tasks.environment import BatchedEnv
from tasks.evaluation import evaluate
from tasks.paired_physics import draw_paired_physics
from tasks.paths import draw_paths
from tasks.rendering import record, render, save, sheet
from tasks.state import State
from torchrl_sym.recipes import load_actor

HERE = Path(__file__).parent
SEED = 2000  # of starts: not those of the evaluation
FRAMES = 5  # key frames of an episode
BOX_HEIGHTS = tuple(0.05 * i for i in range(2, 11))  # m
LIMBS = (*LEGS, "head", "tail")  # the last two are the front and the back half of the trunk


@dataclass
class Arguments:
    """Draw what the policies of a comparison do."""

    name: tyro.conf.Positional[str] = "paper-push"
    """What the results are called."""
    methods: tuple[str, ...] = ("ppo", "aug")
    """Whose policies."""
    tasks: tuple[str, ...] = ()
    """module:function that the results may name, beside the tasks and the presets: it is imported."""
    episodes: int = 6
    """Per goal, in the figures of paths."""
    touching: int = 50
    """Episodes per goal, in the figures of limbs and of heights."""
    seconds: float | None = None
    """Length of the episodes; the task's own when left out."""
    results: Path = HERE / "results"
    """Where results are, in a folder of their name."""
    plots: Path = HERE / "plots"
    """Where pictures go, in a folder of the results' name."""


@dataclass
class Recording:
    """Episodes of one policy: as many of every goal, goal by goal.

    Attributes:
        task: what was run.
        states: all states, of all rows at a time.
        elements: group element of every row.
    """

    task: Task
    states: list[State]
    elements: list[int]

    def first(self, episodes: int) -> "Recording":
        """The first episodes of every goal."""
        each = self.elements.count(0)
        rows = [g * each + k for g in range(len(self.elements) // each) for k in range(episodes)]
        states = [state.rows(torch.tensor(rows)) for state in self.states]
        return Recording(self.task, states, [self.elements[row] for row in rows])


def check(arguments: Arguments, study: Study) -> None:
    """Refuse numbers below one, unknown methods, and results that name a module which nobody asked for.

    Raises:
        ValueError: names the option.
    """
    at_least_one(arguments, "episodes", "touching")
    different("methods", arguments.methods, key=Method.parse)
    presets = [e.tasks for experiments in PRESETS.values() for e in experiments]
    known = {*ALL_TASKS, *(task for each in presets for task in each), *arguments.tasks}
    unknown = [name for name in study if name not in known]
    if unknown:
        raise ValueError(
            f"expected {arguments.name} to be results of {sorted(known)}, got {unknown}, whose modules "
            f"would be imported; if you trust them, add --tasks {' '.join(unknown)}"
        )
    there = {method for task in study.values() for method in task}
    missing = [method for method in arguments.methods if method not in there]
    if missing:
        raise ValueError(f"expected --methods of {arguments.name}, {sorted(there)}, got {missing}")


def evaluated(name: str, seconds: float | None) -> Task:
    """A task as its first evaluation has it."""
    how = next(iter(task_setting(name).evaluations.values()))
    if seconds is not None:
        how = how | {"episode_seconds": seconds}
    return environment(name)(num_envs=1, seed=0, **how).task


def play(task: Task, checkpoint: Path, episodes: int) -> Recording:
    """Episodes of all goals with mean actions, from the images of the same starts."""
    order = task.symmetry.group.order
    elements = [g for g in range(order) for _ in range(episodes)]
    env = BatchedEnv(task, len(elements), num_threads=1, seed=0)
    draw_paired_physics(env, SEED)
    start = task.sample_goal_states(episodes, torch.Generator().manual_seed(SEED))
    actor = load_actor(checkpoint, env, env.symmetry)
    return Recording(task, record(env, actor, start), elements)


def paths(recordings: dict[Method, Recording]):
    """A row per method: paths as run, and mapped back onto the first goal."""
    size = (8, 3.9 * len(recordings) + 0.4)
    figure, axes = plt.subplots(len(recordings), 2, figsize=size, layout="constrained", squeeze=False)
    for row, (method, recording) in zip(axes, recordings.items(), strict=True):
        for axis, mapped in zip(row, (False, True), strict=True):
            shown = (recording.task, recording.states, recording.elements)
            draw_paths(axis, *shown, mapped_back=mapped, headings=False)
            goal = recording.task.goal_names[0]
            axis.set_title(f"{method.label}, mapped back onto {goal}" if mapped else method.label)
        row[0].set_ylabel("y [m]")
    names = axes[0, 0].get_legend_handles_labels()
    figure.legend(*names, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return figure


def touches(recording: Recording, body: str) -> np.ndarray:
    """Share of the time in contact in which each limb is, ``(goals, limbs)``; NaN without contact."""
    task, model = recording.task, recording.task.model
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    touched, trunk = model.body(body).id, model.body("base").id
    prefixes = [model.body(number).name.split("_")[0] for number in range(model.nbody)]
    counts = np.zeros((len(task.goal_names), len(LIMBS) + 1))
    fallen = torch.zeros(len(recording.elements), dtype=torch.bool)
    for state in recording.states:
        over = task.terminated(state)
        fallen = fallen if over is None else fallen | over
        for row in np.flatnonzero(~fallen.numpy()):
            data.qpos[:] = state.qpos[row].numpy()
            mujoco.mj_fwdPosition(model, data)  # pyright: ignore[reportAttributeAccessIssue]
            found = set()
            for pair, place in zip(model.geom_bodyid[data.contact.geom], data.contact.pos, strict=True):
                other = pair[pair != touched]
                if len(other) != 1:
                    continue
                if other[0] == trunk:
                    ahead = (place - data.xpos[trunk]) @ data.xmat[trunk].reshape(3, 3)[:, 0]
                    found.add("head" if ahead > 0 else "tail")
                elif prefixes[other[0]] in LIMBS:
                    found.add(prefixes[other[0]])
            goal = recording.elements[row]
            counts[goal, [LIMBS.index(limb) for limb in found]] += 1
            counts[goal, -1] += bool(found)
    with np.errstate(invalid="ignore"):
        return counts[:, :-1] / counts[:, -1:]


def draw_touches(shares: dict[Method, np.ndarray], goals: tuple[str, ...], body: str):
    """A panel per method: goals by limbs."""
    figure, axes = plt.subplots(
        1, len(shares), figsize=(4.6 * len(shares), 2.9), layout="constrained", squeeze=False
    )
    for axis, (method, share) in zip(axes[0], shares.items(), strict=True):
        axis.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="auto")
        for (row, column), value in np.ndenumerate(share):
            shade = "white" if value > 0.6 else "black"
            text = f"{value:.0%}" if np.isfinite(value) else "-"
            axis.text(column, row, text, ha="center", va="center", color=shade, fontsize=9)
        axis.set_xticks(range(len(LIMBS)), LIMBS)
        axis.set_yticks(range(len(goals)), goals)
        axis.set_title(f"{method.label}: limbs that touch the {body}")
    return figure


def climbed(checkpoint: Path, episodes: int, seconds: float | None) -> np.ndarray:
    """Success on boxes of every height, facing them, ``(heights, goals)``."""
    rates = []
    for height in BOX_HEIGHTS:
        env = BatchedEnv(create("anymal_climb", height=height, episode_seconds=seconds), 1, num_threads=1)
        outcome = evaluate(env, load_actor(checkpoint, env, env.symmetry), episodes, SEED, num_threads=1)
        rates.append(list(outcome.goal_successes.values()))
    return np.array(rates)


def draw_heights(rates: dict[Method, np.ndarray], goals: tuple[str, ...]):
    """Success over the height of the box: a colour per method, dashed for backward."""
    figure, axis = plt.subplots(figsize=(5.2, 3.2), layout="constrained")
    front = np.array([goal.startswith("front") for goal in goals])
    for method, rate in rates.items():
        for name, chosen, line in (("forward", front, "o-"), ("backward", ~front, "s--")):
            values = rate[:, chosen].mean(axis=1)
            style = {"color": color(method), "label": f"{method.label}, {name}", "markersize": 4}
            axis.plot(BOX_HEIGHTS, values, line, **style)
    axis.set(xlabel="height of the box [m]", ylabel="success", ylim=(-0.03, 1.03))
    axis.grid(alpha=0.3)
    axis.legend(frameon=False, fontsize=8)
    return figure


def frames(recordings: dict[Method, Recording], goals: tuple[int, ...]) -> np.ndarray:
    """Key frames of the first episode of some goals, a row per method and goal."""
    rows, captions = [], []
    for method, recording in recordings.items():
        task = recording.task
        cameras = [task.model.camera(i).name for i in range(task.model.ncam)]
        camera = next((name for name in ("follow", "close") if name in cameras), None)
        chosen = np.linspace(0, len(recording.states) - 1, FRAMES).round().astype(int)
        for g in goals:
            first = recording.elements.index(g)
            states = [recording.states[i].rows(torch.tensor([first])) for i in chosen]
            rows.append([image[0] for image in render(task, states, camera=camera)])
            name = f"{method.label}, {task.goal_names[g]}"
            captions.append([f"{name}, {i * task.control_timestep:.1f} s" for i in chosen])
    return sheet(rows, captions)


def main(arguments: Arguments) -> None:
    torch.set_num_threads(1)
    results = arguments.results / arguments.name
    if not (results / "policies").is_dir():
        raise SystemExit(f"expected policies in {results}, found none; run compare.py on a robot task")
    study = read(results)
    check(arguments, study)
    plots = arguments.plots / arguments.name
    plots.mkdir(parents=True, exist_ok=True)
    for name in study:
        folder = policy_folder(results, name)
        kept = {Method.parse(m): folder / m for m in arguments.methods if (folder / m).exists()}
        if not kept:
            print(f"{name}: none of {', '.join(arguments.methods)} is stored; choose others by --methods")
            continue
        task = evaluated(name, arguments.seconds)
        pushing, climbing = name == "anymal_push", name == "anymal_climb"
        played = max(arguments.episodes, arguments.touching * pushing)
        recordings = {m: play(task, folder, played) for m, folder in kept.items()}
        drawn = {"paths": paths({m: each.first(arguments.episodes) for m, each in recordings.items()})}
        if pushing:
            shares = {m: touches(recording, "cube") for m, recording in recordings.items()}
            drawn["touches"] = draw_touches(shares, task.goal_names, "cube")
        if climbing:
            many = arguments.touching, arguments.seconds
            drawn["heights"] = draw_heights(
                {m: climbed(folder, *many) for m, folder in kept.items()}, task.goal_names
            )
        for kind, figure in drawn.items():
            figure.savefig(plots / f"{folder.name}_{kind}.png", dpi=110)
            plt.close(figure)
        save(plots / f"{folder.name}_frames.png", [frames(recordings, (0, 1))])
        print(f"drew {name}: {', '.join([*drawn, 'frames'])}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
