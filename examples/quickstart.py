"""The paper's effect in a few minutes: PPO against PPO with symmetric copies, on CartPole.

The pole starts flat on the right or on the left. Plain PPO often masters one side and lets the pole swing
all the way round from the other; with symmetric copies both sides are solved alike. This script trains a
few seeds of each in parallel processes, evaluates both starting sides, prints the table and draws the
learning curves. Killed and started again, it continues; finished runs are not repeated.
"""

import functools
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
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
from torchrl_sym.recipes import load_actor, read_metrics, train

METHODS = {"PPO": "none", "PPO + augmentation": "all"}
COLORS = {"PPO": "tab:orange", "PPO + augmentation": "tab:blue"}


@dataclass
class Arguments:
    """Train PPO with and without symmetric copies on CartPole, and compare the two starting sides."""

    seeds: int = 3
    """Seeds per method."""
    iterations: int = 150
    """Iterations per run, of 16384 steps each; the effect on the return shows after about 150."""
    episodes: int = 500
    """Evaluation episodes per starting side."""
    workers: int = os.cpu_count() or 1
    """Runs at a time, one thread each."""
    folder: Path = Path("runs/quickstart")
    """Where the runs are kept."""
    picture: Path = Path("runs/quickstart/learning_curves.png")
    """Where the learning curves are drawn."""


def run(method: str, seed: int, iterations: int, folder: Path, progress=None) -> None:
    """One training run, in a process of its own; every finished iteration goes to the progress queue."""
    torch.set_num_threads(1)
    make_env = functools.partial(tasks.make_env, "cartpole", num_threads=1)
    symmetry = make_env(num_envs=1, seed=0).symmetry
    setting = SETTINGS["cartpole"].replace(
        augmentation=METHODS[method], seed=seed, iterations=iterations, checkpoint_interval=1
    )
    for _ in train(setting.config, make_env, symmetry, folder=folder):
        if progress is not None:
            progress.put(1)


def train_all(arguments: Arguments) -> dict[tuple[str, int], Path]:
    """Train every method and seed, as many at a time as there are workers, behind one progress bar."""
    folders = {
        (method, seed): arguments.folder / f"{METHODS[method]}-{seed}"
        for seed in range(arguments.seeds)
        for method in METHODS
    }
    tables = [folder / "metrics.csv" for folder in folders.values()]
    done = sum(len(read_metrics(table)) for table in tables if table.exists())
    total = len(folders) * arguments.iterations
    with multiprocessing.Manager() as manager, tqdm(total=total, initial=done, unit="it") as bar:
        queue = manager.Queue()
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(arguments.workers, mp_context=context) as pool:
            runs = [
                pool.submit(run, method, seed, arguments.iterations, folder, queue)
                for (method, seed), folder in folders.items()
            ]
            bar.set_description(f"{len(runs)} runs, {arguments.workers} at a time")
            while not all(future.done() for future in runs) or not queue.empty():
                try:
                    bar.update(queue.get(timeout=0.5))
                except multiprocessing.queues.Empty:  # nothing finished in the last half second
                    continue
            for future in runs:
                future.result()  # raises what the run raised
    return folders


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
    for (method, seed), result in results.items():
        x = list(METHODS).index(method) + 0.12 * (seed - (len(results) // 2 - 1) / 2)
        values = list(result.goal_means.values())
        right.plot([x, x], values, color=COLORS[method], alpha=0.5)
        right.plot([x], values[:1], ">", color=COLORS[method])
        right.plot([x], values[1:], "<", color=COLORS[method])
    right.set(ylabel="evaluated return", xlim=(-0.6, 1.6))
    right.set_xticks(range(len(METHODS)), [name.replace(" + ", "\n+ ") for name in METHODS])
    right.set_title("start on the right (▸) and left (◂), per seed", fontsize=9)
    count = len(results) // len(METHODS)
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


def main(arguments: Arguments) -> None:
    folders = train_all(arguments)
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
    arguments.picture.with_suffix(".md").write_text(table + "\n")
    draw(curves, results, arguments.picture)
    print(f"\n{table}\n")
    print("right, left: mean return when the pole starts on that side; variation: their difference;")
    print("mirror loss: squared distance of K[pi(s)] from pi(L[s]) on states of the last iteration.")
    print(f"\nlearning curves: {arguments.picture}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
