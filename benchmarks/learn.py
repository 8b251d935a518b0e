"""Does a robot task learn? Train it with its settings, evaluate every goal, draw the curve.

    python benchmarks/learn.py anymal_push            # trains for as long as tasks/settings.py says
    python benchmarks/learn.py anymal_push --plot     # draws again from the results alone

The run can be killed and started again. Results go to benchmarks/results/learn/TASK: metrics.csv (the whole
curve), result.json (settings, versions, evaluation), checkpoint.pt (the policy alone) and curve.png. The
policy is evaluated in steps of 0.005 s whatever it was trained in, with its mean action and with sampled
ones, on as many episodes for every equivalent goal.
"""

import csv
import dataclasses
import json
import math
import platform
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import torch
import tyro
from torchrl.envs.utils import ExplorationType

import tasks
from comparison.provenance import provenance
from comparison.run import environment, read_curve, stage_folders, train_stages
from tasks.evaluation import evaluate
from tasks.settings import SETTINGS, Setting
from torchrl_sym.recipes import export_actor, load_actor, read_metrics

RESULTS = Path(__file__).parent / "results" / "learn"


@dataclass
class Arguments:
    """Train a task with its settings, then evaluate and draw."""

    task: tyro.conf.Positional[str]
    """One of tasks.ALL_TASKS."""
    iterations: int | None = None
    """Collect-and-learn rounds, instead of the settings'."""
    num_envs: int | None = None
    """Simulations, instead of the settings'."""
    augmentation: str | None = None
    """none, all, random or naive, instead of the settings'."""
    seed: int = 0
    """Seed of weights, starts and exploration."""
    episodes: int = 500
    """Evaluation episodes per goal."""
    folder: Path = Path("runs/learn")
    """Where the full checkpoint goes, in a folder of the task's name."""
    output: Path = RESULTS
    """Where results go, in a folder of the task's name."""
    plot: bool = False
    """Only draw."""


def main(arguments: Arguments) -> None:
    torch.set_num_threads(1)
    output = arguments.output / arguments.task
    if not arguments.plot:
        setting = chosen(arguments)
        folder = arguments.folder / arguments.task
        train_stages(setting, environment(arguments.task), folder, progress=True)
        report(arguments, setting, folder, output)
    draw(output)
    (arguments.output / "README.md").write_text(table(arguments.output))
    print(f"written to {output}")


def chosen(arguments: Arguments) -> Setting:
    """The task's setting with what the command line replaces."""
    names = ("iterations", "num_envs", "augmentation", "seed")
    changes = {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}
    return SETTINGS[arguments.task].replace(**changes)


def report(arguments: Arguments, setting: Setting, folder: Path, output: Path) -> None:
    """Evaluate the last policy, and write everything that the pictures need."""
    export_actor(stage_folders(folder)[-1], output)
    curve = read_curve(folder)
    last = curve[-1]
    write_curve(curve, output / "metrics.csv")
    result = provenance() | {
        "stages": [{"config": dataclasses.asdict(s.config), "task": s.task} for s in setting.stages],
        "frames": last["frames"],
        "minutes": last["seconds"] / 60,
        "machine": f"{platform.machine()}, one process, one thread",
    }
    result["evaluation"] = {
        what: {**kwargs, **evaluation(arguments, output, kwargs)}
        for what, kwargs in setting.evaluations.items()
    }
    (output / "result.json").write_text(json.dumps(result, indent=2) + "\n")


def write_curve(whole: list[dict[str, float]], path: Path) -> None:
    """Write the metrics of all stages as one table of some 500 rows."""
    every = math.ceil(len(whole) / 500)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(whole[0]))
        writer.writeheader()
        for row in whole[::-every][::-1]:  # the last row is kept
            exact = ("stage", "iteration", "frames")
            writer.writerow({k: int(v) if k in exact else f"{v:.5g}" for k, v in row.items()})


def table(folder: Path) -> str:
    """What every task reached, as Markdown, from the stored results alone."""
    head = ["task", "what", "million steps", "minutes", "actions", "success", "worst goal", "best goal"]
    head += ["return", "variation"]
    lines = [head, ["---"] * len(head)]
    for path in sorted(folder.glob("*/result.json")):
        result = json.loads(path.read_text())
        for what, evaluation in result["evaluation"].items():
            for actions in ("deterministic", "sampled"):
                figures = evaluation[actions]
                rates = [f"{rate:.1%}" for rate in sorted(figures["goal_successes"].values())] or ["-"]
                success = "-" if figures["success"] is None else f"{figures['success']:.1%}"
                cells = [
                    path.parent.name,
                    what,
                    f"{result['frames'] / 1e6:.1f}",
                    f"{result['minutes']:.0f}",
                ]
                cells += [actions, success, rates[0], rates[-1]]
                lines.append([*cells, f"{figures['return']:.2f}", f"{figures['variation']:.2f}"])
    text = (
        "Made by `python benchmarks/learn.py TASK`: one seed each, one process with one thread; settings,\n"
        "versions and rates of every goal are in `result.json` of each task. Minutes are wall clock, and\n"
        "the two cores had other jobs as well.\n\n"
    )
    text += "".join(f"| {' | '.join(line)} |\n" for line in lines)
    for path in sorted(folder.glob("*/curve.png")):
        text += f"\n## {path.parent.name}\n\n![Training curves]({path.parent.name}/curve.png)\n"
    return text


def evaluation(arguments: Arguments, output: Path, task: dict[str, Any]) -> dict[str, Any]:
    """Every goal, with the mean action and with sampled ones."""
    env = tasks.make_env(arguments.task, num_envs=1, num_threads=2, **task)
    actor = load_actor(output, env, env.symmetry)
    result = {}
    for name, exploration in (
        ("deterministic", ExplorationType.DETERMINISTIC),
        ("sampled", ExplorationType.RANDOM),
    ):
        outcome = evaluate(env, actor, arguments.episodes, seed=1000, exploration=exploration)
        result[name] = {
            "episodes_per_goal": arguments.episodes,
            "success": outcome.success,
            "goal_successes": outcome.goal_successes,
            "return": outcome.mean,
            "variation": outcome.variation,
            "goal_returns": outcome.goal_means,
            "goal_task_returns": outcome.task_means,
            "terms": {term: float(x.mean()) for term, x in (outcome.terms or {}).items()},
        }
        rates = ", ".join(f"{goal} {rate:.1%}" for goal, rate in outcome.goal_successes.items())
        print(f"{task or 'task'}, {name}: success {rates}")
    return result


def draw(output: Path) -> None:
    """Success, curriculum and return over environment steps."""
    rows = read_metrics(output / "metrics.csv")
    names = [
        name for name in ("success", "level", "error", "distance", "phase", "return") if name in rows[0]
    ]
    steps = [row["frames"] / 1e6 for row in rows]
    figure, axes = plt.subplots(1, len(names), figsize=(3.2 * len(names), 2.8), layout="constrained")
    for axis, name in zip([axes] if len(names) == 1 else axes, names, strict=True):
        axis.plot(steps, [row[name] for row in rows], color="tab:blue", linewidth=1.2)
        axis.set(xlabel="environment steps (millions)", title=name)
        axis.grid(alpha=0.3)
        if name == "success":
            axis.set_ylim(0, 1)
    figure.savefig(output / "curve.png", dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
