"""The paper's experiments in one command: methods x tasks x seeds, resumable, drawn at the end.

    python benchmarks/compare.py --preset smoke             # everything once, tiny: under 3 minutes
    python benchmarks/compare.py --preset paper-cartpole    # CartPole in full: under an hour on two cores
    python benchmarks/compare.py --preset paper-cartpole-20 # 20 minutes more: 20 seeds where it matters
    python benchmarks/compare.py --preset paper-push        # a robot: a night on two cores
    python benchmarks/compare.py --preset paper             # all of them: days on two cores
    python benchmarks/compare.py --tasks anymal_push --methods ppo aug-random --seeds 5

Every run is a process of its own with one thread, as many at a time as there are cores. Kill it whenever
you like: the same command goes on where it was and ends in the same results. A run that fails, or of which
a file is damaged, is reported and does not stop the others. Results go to benchmarks/results/NAME as tidy
tables; `plot.py` draws them; with `--extend`, only what they lack is trained.

Your own task is `--tasks module:function`, a function that takes `num_envs` and `seed` and returns an
environment with a `symmetry`; hyper-parameters are a `SETTING` in its module, or `--config KEY=VALUE ...`.
A task with arguments of its own is trained and evaluated with them (`--tasks cartpole@motor_bias=0.5`).
"""

import ast
import dataclasses
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from comparison import writing
from comparison.cluster import cluster
from comparison.environments import check_arguments, task_arguments, task_setting
from comparison.experiments import OWN, PRESETS, Experiment
from comparison.methods import METHOD_FIELDS, Method
from comparison.options import at_least_one, different
from comparison.pool import damaged, execute_all, report
from comparison.records import EarlierResults
from comparison.run import Run
from tasks.settings import Setting
from torchrl_sym.recipes import PPOConfig, RunFolder

HERE = Path(__file__).parent


@dataclass
class Arguments:
    """Compare methods, then draw figures and tables."""

    preset: Literal[tuple(PRESETS)] | None = None  # type: ignore[valid-type]
    """A named set of experiments, instead of tasks, methods, seeds and steps."""
    # None: not given. A preset fixes what an option would change, also where it would change nothing.
    tasks: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="TASK ...")] = None
    """Names of tasks, or module:function, also with arguments: cartpole@motor_bias=0.5 (cartpole)."""
    methods: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="METHOD ...")] = None
    """ppo, aug, aug-random, aug-naive, aug-naive-raw, equivariant, relaxed, loss-W, init-S, symmetric-init,
    sums of them (ppo aug)."""
    seeds: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Seeds per method, from 0 (5): with more of them later, the first are not trained again."""
    steps: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Environment steps per run, instead of the task's settings."""
    config: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="KEY=VALUE ...")] = None
    """Changes of PPOConfig for all runs, such as num_envs=64 'hidden=(64,64)'."""
    episodes: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Evaluation episodes per goal (500)."""
    under: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="KEY=VALUE ...")] = None
    """Evaluate in addition with other arguments of the task, such as motor_bias=0.5, once for each."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Runs at a time (as many as there are cores)."""
    ray: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="[ADDRESS]")] = None
    """Run on a Ray cluster: at this address, or that of RAY_ADDRESS, or else of this machine alone."""
    extend: bool = False
    """Train only what the results lack: runs that they hold already stay in them as they are."""
    collect: bool = False
    """Train nothing: write and draw what has been finished so far, and what the results hold already."""
    threads: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Threads per run (1)."""
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
    common = (arguments.preset or "").startswith(("paper", "study"))  # these have runs in common
    shared = "paper" if common else name
    runs = make_runs(arguments, (arguments.folder / shared).absolute())
    folder = arguments.output / name
    earlier = EarlierResults(folder) if arguments.collect or arguments.extend else None
    known = [run for run in runs if earlier and run.result() is None and earlier.record(run)]
    wanted = [run for run in runs if run not in known]
    about = {"workers": arguments.workers or os.cpu_count() or 1, "threads": arguments.threads or 1}
    if arguments.collect:
        failed = damaged(wanted)
    else:
        with RunFolder(arguments.folder / shared):  # two comparisons must not share their runs
            failed = execute_all(wanted, about["workers"])
    report(failed)
    if not known and not any(run.result() for run in runs):
        print("no run has been finished; there is nothing to write")
        return 1
    if arguments.collect:  # how runs were made is not for this command to say
        about = {key: earlier.about.get(key) if earlier else None for key in about}
    if earlier and len(known) == len(runs):  # nor where nothing is new
        kept = (*about, "command", "collected_at")
        about |= {key: earlier.about[key] for key in kept if key in earlier.about}
    writing.write(folder, runs, failed, about, earlier=earlier)
    for path in plot.draw_all(folder, arguments.plots / name):
        print(f"wrote {path}")
    return 1 if failed else 0


def execute(runs: Sequence[Run], arguments: Arguments) -> tuple[list[Run], int]:
    """Execute what is not finished, here or on a cluster: runs that failed, and how many ran at a time."""
    if arguments.ray is None:
        workers = arguments.workers or os.cpu_count() or 1
        return execute_all(runs, workers), workers
    with cluster(*arguments.ray, threads=arguments.threads or 1) as (start, room):
        workers = min(arguments.workers or room, room)
        return execute_all(runs, workers, start), workers


def make_runs(arguments: Arguments, folder: Path) -> list[Run]:
    """All runs, seed by seed, so that an interrupted comparison has some seeds of every method."""
    runs: dict[Path, Run] = {}  # by folder: experiments may overlap
    for experiment in chosen(arguments):
        for seed in range(experiment.seeds):
            for task in experiment.tasks:
                setting = evaluated_under(experiment.under, task)
                for method in experiment.methods:
                    asked = Method.parse(method)
                    changed = asked.configure(setting, seed, experiment.steps, **experiment.config)
                    where = folder / task.replace(":", ".") / method / f"seed_{seed}"
                    more = (experiment.episodes, arguments.threads or 1)
                    runs[where] = Run(task, method, seed, changed, where, *more)
    return list(runs.values())


def evaluated_under(under: Sequence[str], task: str) -> Setting:
    """Settings of a task, evaluated also with other arguments of its own, by what these are."""
    setting = task_setting(task)
    usual = next(iter(setting.evaluations.values()))
    more = {each: usual | task_arguments(each) for each in under}
    for own in more.values():
        check_arguments(task, own)
    return dataclasses.replace(setting, evaluations=setting.evaluations | more)


def check(arguments: Arguments) -> None:
    """Refuse options that contradict each other, that would be ignored, or that are out of range.

    Raises:
        ValueError: names the option.
    """
    at_least_one(arguments, "seeds", "steps", "episodes", "workers", "threads")
    if arguments.name is not None and Path(arguments.name).name != arguments.name:
        raise ValueError(f"expected a --name without a path, got {arguments.name!r}; see --output")
    if arguments.ray is not None and len(arguments.ray) > 1:
        raise ValueError(f"expected --ray with one address or none, got {list(arguments.ray)}")
    ignored = ("extend", "workers", "threads", "ray")
    given = [f"--{name}" for name in ignored if getattr(arguments, name) not in (None, False)]
    if arguments.collect and given:
        raise ValueError(
            f"expected --collect, which trains nothing, without {given}; leave out one or the other"
        )


def chosen(arguments: Arguments) -> Sequence[Experiment]:
    """The experiments that the command line asks for.

    Raises:
        ValueError: a preset and options that it fixes, or the same thing twice.
    """
    check(arguments)
    fixed = [field.name for field in dataclasses.fields(Experiment)]
    given = {name: getattr(arguments, name) for name in fixed if getattr(arguments, name) is not None}
    if arguments.preset is not None:
        if given:
            raise ValueError(
                f"expected a preset alone, got --preset {arguments.preset} and {list(given)}, which it "
                "fixes; leave out one or the other"
            )
        return PRESETS[arguments.preset]
    if "config" in given:
        different("config", given["config"], key=lambda text: text.partition("=")[0])
        given["config"] = dict(parse(text) for text in given["config"])
    if "under" in given:
        different("under", given["under"])
    experiment = dataclasses.replace(OWN, **given)
    different("tasks", experiment.tasks)
    different("methods", experiment.methods, key=Method.parse)
    return [experiment]


def parse(text: str) -> tuple[str, Any]:
    """A change of the configuration, `KEY=VALUE`, the value in Python's notation or plain text.

    Whether the field takes the value is for `PPOConfig` to say, when runs are made.

    Raises:
        ValueError: not of this form, no such field, or a field that is the method's.
    """
    free = sorted({field.name for field in dataclasses.fields(PPOConfig)} - METHOD_FIELDS)
    key, equals, value = text.partition("=")
    if not equals or key not in free:
        raise ValueError(f"expected KEY=VALUE, such as num_envs=64, with a key of {free}, got {text!r}")
    try:
        return key, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return key, value


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments)))
