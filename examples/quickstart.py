"""The paper's effect in a few minutes: PPO against PPO with symmetric copies, on CartPole.

The pole starts flat on the right or on the left. Plain PPO masters one side better than the other, at times
by a detour from one of them; with symmetric copies both sides are solved alike. This script trains a
few seeds of each in parallel processes, each method with the settings that were tuned for it, evaluates
both starting sides, prints the table and draws the learning curves. Killed and started again, it continues;
finished runs are not repeated.
"""

import functools
import multiprocessing
import os
import sys
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
import tyro
from matplotlib.axes import Axes
from tqdm import tqdm

import tasks
from tasks.evaluation import Evaluation, evaluate
from tasks.settings import SETTINGS
from torchrl_sym.recipes import RunFolder, load_actor, read_metrics, train
from torchrl_sym.recipes.runs import read_progress
from torchrl_sym.recipes.workers import end_with_parent

SETTING = SETTINGS["cartpole"]
METHODS = {
    "PPO": SETTING.tuned_for("ppo").replace(augmentation="none"),
    "PPO + augmentation": SETTING.tuned_for("aug").replace(augmentation="all"),
}
COLORS = {"PPO": "tab:orange", "PPO + augmentation": "tab:blue"}
# A side that is solved by swinging the long way round costs about 2 more than the other.
DETOUR = 1.0


@dataclass
class Arguments:
    """Train PPO with and without symmetric copies on CartPole, and compare the two starting sides."""

    seeds: int = 3
    """Seeds per method."""
    first_seed: int = 0
    """The first of them."""
    iterations: int = SETTING.config.iterations
    """Iterations per run, of 16384 steps each."""
    episodes: int = 500
    """Evaluation episodes per starting side."""
    workers: int = os.cpu_count() or 1
    """Runs at a time, one thread each."""
    folder: Path = Path("runs/quickstart")
    """Where the runs are kept."""
    picture: Path = Path("runs/quickstart/learning_curves.png")
    """Where the learning curves are drawn."""

    def __post_init__(self) -> None:
        for name in ("seeds", "iterations", "episodes", "workers"):
            if getattr(self, name) < 1:
                raise SystemExit(f"expected --{name} of at least 1, got {getattr(self, name)}")


def run(method: str, seed: int, iterations: int, folder: Path) -> None:
    """One training run, in a process of its own."""
    torch.set_num_threads(1)
    make_env = functools.partial(tasks.make_env, "cartpole", num_threads=1)
    config = METHODS[method].replace(seed=seed, iterations=iterations).config
    train(config, make_env, make_env(num_envs=1, seed=0).symmetry, folder=folder).run()


def train_all(arguments: Arguments) -> dict[tuple[str, int], Path]:
    """Train every method and seed, as many at a time as there are workers, behind one progress bar."""
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    folders = {
        (method, seed): arguments.folder / f"{config.augmentation}-{seed}"
        for seed in seeds
        for method, config in ((name, setting.config) for name, setting in METHODS.items())
    }
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(arguments.workers, mp_context=context, initializer=end_with_parent)
    before = done_in(folders.values())
    bar = tqdm(total=len(folders) * arguments.iterations, initial=before, unit="it", smoothing=0.02)
    bar.set_description(f"{len(folders)} runs, {arguments.workers} at a time")
    try:
        waiting = {pool.submit(run, *key, arguments.iterations, folder) for key, folder in folders.items()}
        while waiting:
            ended, waiting = wait(waiting, timeout=0.5, return_when=FIRST_EXCEPTION)
            bar.update(done_in(folders.values()) - bar.n)
            for future in ended:
                future.result()  # raises what the run raised
    except BaseException:
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        bar.close()
    return folders


def done_in(folders) -> int:
    """Iterations that have been done in all folders."""
    return sum(read_progress(folder)[0] for folder in folders)


def make_table(results: dict[tuple[str, int], Evaluation], curves: dict[tuple[str, int], list]) -> str:
    """One row per run, then the mean of each method, as a Markdown table."""
    lines = [
        "| method             | seed |   right |    left |    mean | variation | mirror loss |",
        "|--------------------|-----:|--------:|--------:|--------:|----------:|------------:|",
    ]
    for method in METHODS:
        rows = []
        for (name, seed), result in results.items():
            if name == method:
                mirror = curves[name, seed][-1]["mirror_loss"]
                rows.append([*result.goal_means.values(), result.mean, result.variation, mirror])
                lines.append(f"| {method:18s} | {seed:4d} | {_row(rows[-1])} |")
        lines.append(f"| {method:18s} | mean | {_row(np.mean(rows, axis=0))} |")
    return "\n".join(lines)


def _row(values) -> str:
    right, left, mean, variation, mirror = values
    return f"{right:7.3f} | {left:7.3f} | {mean:7.3f} | {variation:9.3f} | {mirror:11.4f}"


def draw(
    curves: dict[tuple[str, int], list], results: dict[tuple[str, int], Evaluation], path: Path
) -> None:
    """Learning curves of return and mirror loss, and the evaluated return of both starting sides."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(12, 3.6), width_ratios=(3, 3, 2))
    for method in METHODS:
        rows = [rows for (name, _), rows in curves.items() if name == method]
        draw_curve(left, method, rows, "return")
        draw_curve(middle, method, rows, "mirror_loss")
    left.set(xlabel="million steps", ylabel="training return")
    middle.set(xlabel="million steps", ylabel="mirror loss", yscale="log")
    left.legend(frameon=False, loc="lower right")
    count = len(results) // len(METHODS)
    first = min(seed for _, seed in results)
    for (method, seed), result in results.items():
        x = list(METHODS).index(method) + min(0.12, 0.7 / count) * (seed - first - (count - 1) / 2)
        values = list(result.goal_means.values())
        right.plot([x, x], values, color=COLORS[method], alpha=0.5)
        right.plot([x], values[:1], ">", color=COLORS[method])
        right.plot([x], values[1:], "<", color=COLORS[method])
    right.set(ylabel="evaluated return", xlim=(-0.6, 1.6))
    right.set_xticks(range(len(METHODS)), [name.replace(" + ", "\n+ ") for name in METHODS])
    right.set_title("start on the right (▸) and left (◂), per seed", fontsize=9)
    left.set_title(f"mean and range of {count} seed{'s' * (count > 1)}", fontsize=9)
    for axes in (left, middle, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def draw_curve(axes: Axes, method: str, runs: list[list[dict]], key: str) -> None:
    """Mean over the seeds, and the range between the lowest and the highest."""
    frames = np.array([row["frames"] for row in runs[0]]) / 1e6
    values = np.array([[row[key] for row in rows] for rows in runs])
    axes.plot(frames, values.mean(axis=0), color=COLORS[method], label=method)
    axes.fill_between(
        frames, values.min(axis=0), values.max(axis=0), color=COLORS[method], alpha=0.2, linewidth=0
    )


def summary(results: dict[tuple[str, int], Evaluation]) -> str:
    """What was seen, in words that follow from the numbers."""
    lines = [f"What you saw, in {len(results) // len(METHODS)} runs each:"]
    for method in METHODS:
        found = [result for (name, _), result in results.items() if name == method]
        means, gaps = [r.mean for r in found], [r.variation for r in found]
        lines.append(
            f"  {method}: mean return {np.mean(means):.2f}, the worst run {min(means):.2f};\n"
            f"    its two sides differ by {np.mean(gaps):.3f} on average, by {max(gaps):.3f} at most"
        )
        detours = sum(gap > DETOUR for gap in gaps)
        if detours:
            lines.append(f"    (by more than {DETOUR:g}, a detour from one side, in {detours} of them)")
    return "\n".join(lines)


def advice() -> str:
    """What to do next, with commands for the interpreter that runs this."""
    python = os.path.relpath(sys.executable) if Path.cwd() in Path(sys.executable).parents else "python"
    return f"""What to do next:
  {python} examples/train.py --help      train a robot: ANYmal pushes or climbs, three fingers repose
  {python} examples/own_environment.py   declare and verify the symmetry of an environment
  Your own robot: README.md, "Declare the symmetry of your robot"; the paper's claims: docs/results.md"""


def main(arguments: Arguments) -> None:
    try:
        with RunFolder(arguments.folder):  # a second start must not take the runs that wait
            folders = train_all(arguments)
    except (BlockingIOError, ValueError) as error:
        raise SystemExit(str(error)) from error

    env = tasks.make_env("cartpole", num_envs=1, num_threads=1)
    curves = {
        key: read_metrics(folder / "metrics.csv")[: arguments.iterations] for key, folder in folders.items()
    }
    results = {
        key: evaluate(env, load_actor(folder, env, env.symmetry), arguments.episodes)
        for key, folder in folders.items()
    }
    table = make_table(results, curves)
    arguments.picture.parent.mkdir(parents=True, exist_ok=True)
    made = f"Made by `python {' '.join(sys.argv)}`:"
    arguments.picture.with_suffix(".md").write_text(f"{made}\n\n{table}\n\n{summary(results)}\n")
    draw(curves, results, arguments.picture)
    print(f"\n{table}\n")
    print("right, left: mean return when the pole starts on that side; variation: their difference;")
    print("mirror loss: squared distance of K[pi(s)] from pi(L[s]) on states of the last iteration.")
    print(f"\nlearning curves: {arguments.picture}\n\n{summary(results)}\n\n{advice()}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
