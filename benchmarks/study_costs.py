"""What a training step costs with each method of the study: processor time, all methods in turn.

    python benchmarks/study_costs.py                 # four minutes on a quiet machine

Runs of the study share their machine with whatever else it does, at different times. Steps compare them;
what a step costs is measured here, in one process and one thread, round by round.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median

import torch
import tyro

from comparison.environments import environment, task_setting
from comparison.experiments import PRESETS
from comparison.files import write_whole
from comparison.methods import Method
from comparison.options import at_least_one
from comparison.provenance import origin
from measuring import interleave
from torchrl_sym.recipes import train

HERE = Path(__file__).parent


@dataclass
class Arguments:
    """Measure what a training step costs."""

    presets: tuple[str, ...] = ("study-cartpole", "study-push")
    """Whose tasks and methods."""
    rounds: int = 5
    """Iterations of each, after two of warm-up."""
    output: Path = HERE / "results" / "study-costs.json"
    """Where the numbers go: processor seconds per million steps, by task and method."""


def main(arguments: Arguments) -> int:
    at_least_one(arguments, "rounds")
    torch.set_num_threads(1)
    costs = {task: dict(measure(task, preset, arguments.rounds)) for task, preset in tasks(arguments)}
    about = {"origin": origin(), "rounds": arguments.rounds, "costs": costs}
    write_whole(arguments.output, json.dumps(about, indent=1) + "\n")
    for task, each in costs.items():
        for method, seconds in each.items():
            print(f"{task:20s} {method:28s} {seconds:7.1f} s per million steps")
    return 0


def tasks(arguments: Arguments) -> Iterator[tuple[str, str]]:
    """Each task, with the preset that it is of."""
    for preset in arguments.presets:
        yield PRESETS[preset][0].tasks[0], preset


def measure(task: str, preset: str, rounds: int) -> Iterator[tuple[str, float]]:
    """Every method, and seconds per million steps."""
    methods = list(dict.fromkeys(method for experiment in PRESETS[preset] for method in experiment.methods))
    make_env, setting = environment(task), task_setting(task)
    symmetry = make_env(num_envs=1, seed=0).symmetry
    variants, sizes = {}, {}
    for name in methods:
        config = Method.parse(name).configure(setting, 0).config
        training = train(
            dataclasses.replace(config, iterations=10**9), partial(make_env, **setting.task), symmetry
        )
        variants[name], sizes[name] = partial(next, training), config.num_envs * config.horizon
    seconds = interleave(variants, rounds, time.process_time)
    for name in methods:
        yield name, 1e6 * median(seconds[name]) / sizes[name]


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments)))
