"""Does symmetric replay help SAC and TD3? Curves on gymnasium's Ant, and the rules that judge them.

    python benchmarks/off_policy.py              # trains what is not finished, then writes results and page
    python benchmarks/off_policy.py --collect    # trains nothing

Four runs, {SAC, TD3} x {plain, symmetric}, of five seeds each (`ant/training.py`). The two arms of an
algorithm differ in one thing: the symmetric one maps every sampled row by one random element of {e,
reflect-y} before the loss sees it. Networks, hyper-parameters, frames, updates and rows per update are
equal, and so are, seed by seed, the initial networks and the seeds of the environments, which is why
differences are taken in pairs. Settings were chosen with other seeds (100 and above), the first of them
in pilots of either arm, the last ones on the plain arm.

The rules, written before the study ran:

1. Primary measure: the area under the evaluation curve, which is the mean over all evaluations of the
   deterministic policy's return. Per algorithm, the interquartile mean over seeds of the paired
   difference (symmetric minus plain) with its 95 % bootstrap interval decides: symmetric replay "helps"
   if the interval lies above zero, "hurts" if it lies below, and is "undecided" otherwise.
2. Second measure: the mirror error of the policy, the mean square over action entries of pi(L_g s) - K_g
   pi(s) at the states that evaluations visit, over the last quarter of the evaluations. The policy is
   "more symmetric" if the interval of the paired difference lies below zero, "less symmetric" if it lies
   above, and otherwise "undecided".
3. Third, by the rule of the second: the drift, how far the episodes of one evaluation end on average to
   one side, |mean of y| in metres, over the last quarter of the evaluations ("straighter", "less
   straight").
4. The return of the last quarter of the evaluations is reported without a verdict. Seeds are 0 to 4, no
   others are tried, none is dropped, and no setting of an algorithm changes after its first run has
   started.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import multiprocessing
import os
import platform
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import torch
import tyro

from ant.report import page, picture, read
from ant.training import Setting, train, write
from torchrl_sym.recipes.workers import end_with_parent

ROOT = Path(__file__).parents[1]
SETTINGS = [Setting(algorithm, arm) for algorithm in ("sac", "td3") for arm in ("plain", "symmetric")]
PACKAGES = ("torch", "torchrl", "tensordict", "gymnasium", "mujoco")


@dataclass
class Arguments:
    """Train what is not finished, and write the results."""

    runs: Path = ROOT / "runs" / "off-policy"
    """Where a run leaves its curve; a finished one is not repeated, a killed one starts again."""
    results: Path = ROOT / "benchmarks" / "results" / "off-policy"
    """Where the table of all curves goes, and how it came about."""
    plots: Path = ROOT / "benchmarks" / "plots" / "off-policy"
    """Where the picture goes."""
    page: Path = ROOT / "docs" / "off_policy.md"
    """Where the page goes."""
    workers: int = 2
    """Runs at a time, of one thread each."""
    algorithms: tuple[Literal["sac", "td3"], ...] = ("sac", "td3")
    """Which of them to train."""
    collect: bool = False
    """Train nothing."""


def run(setting: Setting, path: Path) -> None:
    """Train the seeds of a run and leave their curves at `path`, which is there once they are finished."""
    torch.set_num_threads(1)
    rows, started = [], time.monotonic()
    for measured in train(setting):
        rows += measured
        write(rows, path.with_suffix(".growing"))
        returns = " ".join(f"{row['return']:.0f}" for row in measured)
        spent = f"{measured[0]['seconds']:.0f} s of CPU, {time.monotonic() - started:.0f} s"
        print(f"{setting.name}: {measured[0]['frames']} frames, {spent}, returns {returns}", flush=True)
    path.with_suffix(".growing").rename(path)


def run_all(settings: Sequence[Setting], runs: Path, workers: int) -> None:
    """Train every run that is not finished, each in a process of its own."""
    missing = {setting: runs / f"{setting.name}.csv" for setting in settings}
    missing = {setting: path for setting, path in missing.items() if not path.exists()}
    runs.mkdir(parents=True, exist_ok=True)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, end_with_parent) as pool:
        futures = {pool.submit(run, *one): one[0].name for one in missing.items()}
        for future in as_completed(futures):
            future.result()
            print(f"{futures[future]}: finished", flush=True)


def collect(settings: Sequence[Setting], runs: Path, results: Path) -> None:
    """One table of the curves of all finished runs, and a description of how they came about."""
    paths = [path for setting in settings if (path := runs / f"{setting.name}.csv").exists()]
    if not paths:
        raise SystemExit(f"no run is finished in {runs}")
    rows = [row for path in paths for row in csv.DictReader(path.read_text().splitlines())]
    study = {
        "command": "python benchmarks/off_policy.py",
        "setting": {
            k: v for k, v in dataclasses.asdict(settings[0]).items() if k not in ("algorithm", "arm")
        },
        "packages": {name: version(name) for name in PACKAGES} | {"python": platform.python_version()},
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, one thread per run",
    }
    results.mkdir(parents=True, exist_ok=True)
    write(rows, results / "curves.csv")
    (results / "study.json").write_text(json.dumps(study, indent=2) + "\n")


def draw(results: Path, plots: Path, to: Path) -> None:
    """Picture and page, from the stored results alone."""
    curves, study = read(results / "curves.csv"), json.loads((results / "study.json").read_text())
    picture(curves, plots / "curves.png")
    to.write_text(page(curves, study))


def main(arguments: Arguments, settings: Sequence[Setting] = SETTINGS) -> None:
    if not arguments.collect:
        chosen = [setting for setting in settings if setting.algorithm in arguments.algorithms]
        run_all(chosen, arguments.runs, arguments.workers)
    collect(settings, arguments.runs, arguments.results)
    draw(arguments.results, arguments.plots, arguments.page)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
