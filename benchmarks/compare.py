"""The paper's experiments in one command: methods x tasks x seeds, resumable, drawn at the end.

    python benchmarks/compare.py --preset smoke             # everything once, tiny: under 3 minutes
    python benchmarks/compare.py --preset paper-cartpole    # CartPole in full: under an hour on two cores
    python benchmarks/compare.py --preset paper             # the robots as well: days on two cores
    python benchmarks/compare.py --tasks anymal_push --methods ppo aug-random --seeds 5

Every run is a process of its own with one thread, as many at a time as there are cores. Kill it whenever
you like: the same command goes on where it was and ends in the same results. A run that fails is reported
and does not stop the others. Results go to benchmarks/results/NAME as tidy tables; `plot.py` draws them.

Your own task is `--tasks module:function`, a function that takes `num_envs` and `seed` and returns an
environment with a `symmetry`; hyper-parameters are a `SETTING` in its module, or `--config KEY=VALUE ...`.
"""

import ast
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from comparison import study
from comparison.methods import configure
from comparison.pool import execute_all
from comparison.run import Run, task_setting

HERE = Path(__file__).parent

MAIN = ("ppo", "aug", "aug-random", "loss-0.1", "loss-1", "loss-10", "aug+loss-0.1")
SCALES = ("aug+init-0.1", "aug+init-4", "aug+loss-0.1+init-4")


@dataclass(frozen=True)
class Experiment:
    """Some methods on some tasks.

    Attributes:
        tasks: names, or `module:function`.
        methods: see `comparison/methods.py`.
        seeds: how many, from 0.
        steps: environment steps; None for what the task's settings say.
        config: changes of the configuration.
    """

    tasks: tuple[str, ...]
    methods: tuple[str, ...]
    seeds: int
    steps: int | None = None
    config: dict[str, Any] = field(default_factory=dict)


_TINY = {"num_envs": 32, "horizon": 50, "epochs": 1, "minibatches": 2}
_CARTPOLE = (
    Experiment(("cartpole",), (*MAIN, "aug-naive", *SCALES), 10),
    Experiment(("cartpole",), ("aug-naive-raw",), 5),
)
_DECISIVE = (*_CARTPOLE, Experiment(("cartpole",), ("ppo", "aug", "aug+init-0.1"), 30))

PRESETS: dict[str, tuple[Experiment, ...]] = {
    "smoke": (
        Experiment(("cartpole",), (*MAIN, "aug-naive", "aug-naive-raw", *SCALES), 2, 32 * 50 * 12, _TINY),
        Experiment(("anymal_push", "anymal_climb", "trifinger_repose"), ("ppo", "aug"), 1, 3200, _TINY),
    ),
    "paper-cartpole": _CARTPOLE,
    "paper-cartpole-seeds": _DECISIVE,  # which method is faster takes more seeds to decide
    "paper": (
        *_DECISIVE,
        Experiment(("anymal_push",), MAIN, 5),
        Experiment(("anymal_climb", "trifinger_repose"), MAIN, 3),
    ),
}


@dataclass
class Arguments:
    """Compare methods, then draw figures and tables."""

    preset: Literal["smoke", "paper-cartpole", "paper-cartpole-seeds", "paper"] | None = None
    """A named set of experiments, instead of tasks, methods, seeds and steps."""
    tasks: tuple[str, ...] = ("cartpole",)
    """Names of tasks, or module:function."""
    methods: tuple[str, ...] = ("ppo", "aug")
    """ppo, aug, aug-random, aug-naive, aug-naive-raw, loss-W, init-S, and sums of them."""
    seeds: int = 5
    """Seeds per method."""
    first_seed: int = 0
    """The first of them."""
    steps: int | None = None
    """Environment steps per run, instead of the task's settings."""
    config: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """Changes of PPOConfig for all runs, such as num_envs=64 hidden=(64,64)."""
    episodes: int = 500
    """Evaluation episodes per goal."""
    workers: int = os.cpu_count() or 1
    """Runs at a time."""
    threads: int = 1
    """Threads per run."""
    name: str | None = None
    """What the results are called; by default the preset, or else `custom`."""
    folder: Path = Path("runs/compare")
    """Where runs keep checkpoints and logs."""
    output: Path = HERE / "results"
    """Where results go, in a folder of their name."""
    plots: Path = HERE / "plots"
    """Where figures and tables go, in a folder of the results' name."""


def main(arguments: Arguments) -> int:
    import plot  # every run's process imports this file, and has no use for matplotlib and scipy

    name = arguments.name or arguments.preset or "custom"
    shared = "paper" if (arguments.preset or "").startswith("paper") else name  # they have runs in common
    runs = make_runs(arguments, arguments.folder / shared)
    failed = execute_all(runs, arguments.workers)
    about = {"workers": arguments.workers, "threads": arguments.threads, "episodes": arguments.episodes}
    study.write(arguments.output / name, runs, failed, about)
    if len(failed) == len(runs):
        print("every run failed; nothing to draw")
        return 1
    for path in plot.draw_all(arguments.output / name, arguments.plots / name):
        print(f"wrote {path}")
    for run in failed:
        print(f"FAILED: {run} (see {run.folder / 'log.txt'})")
    return 1 if failed else 0


def make_runs(arguments: Arguments, folder: Path) -> list[Run]:
    """All runs, seed by seed, so that an interrupted comparison has some seeds of every method."""
    config = dict(parse(text) for text in arguments.config)
    if arguments.preset is not None:
        experiments: Sequence[Experiment] = PRESETS[arguments.preset]
    else:
        a = arguments
        experiments = (Experiment(a.tasks, a.methods, a.seeds, a.steps, config),)
    runs: dict[Path, Run] = {}  # by folder: experiments may overlap
    for experiment in experiments:
        for seed in range(arguments.first_seed, arguments.first_seed + experiment.seeds):
            for task in experiment.tasks:
                setting = task_setting(task)
                for method in experiment.methods:
                    changed = configure(task, method, setting, seed, experiment.steps, **experiment.config)
                    where = folder / task.replace(":", ".") / method / f"seed_{seed}"
                    episodes = 4 if arguments.preset == "smoke" else arguments.episodes
                    runs[where] = Run(task, method, seed, changed, where, episodes, arguments.threads)
    return list(runs.values())


def parse(text: str) -> tuple[str, Any]:
    """A change of the configuration, `KEY=VALUE`, the value in Python's notation or plain text.

    Raises:
        ValueError: there is no equals sign.
    """
    key, equals, value = text.partition("=")
    if not equals:
        raise ValueError(f"expected KEY=VALUE, such as num_envs=64, got {text!r}")
    try:
        return key, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return key, value


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments)))
