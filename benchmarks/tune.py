"""The same search for every family of methods, so that no baseline is weaker for want of tuning.

    python benchmarks/tune.py                        # CartPole: about 40 minutes on two cores

Every family (plain PPO, augmentation, mirror loss, naive augmentation) tries the same candidates with the
same seeds; the best two get more seeds; the best mean return wins. The seeds are not those of the
comparison. The winners are written down in `tasks.settings` (`Setting.tuned`) by hand.
"""

from __future__ import annotations

import dataclasses
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from comparison.environments import task_setting
from comparison.files import write_whole
from comparison.markdown import markdown
from comparison.methods import Method
from comparison.options import at_least_one, different
from comparison.pool import execute_all, report
from comparison.run import Run
from comparison.writing import write
from torchrl_sym.recipes import RunFolder

if TYPE_CHECKING:
    from comparison.study import Study

HERE = Path(__file__).parent
FAMILIES = ("ppo", "aug", "loss-1", "aug-naive")
FIRST, MORE = (100, 101), (102, 103, 104)  # seeds of both rounds
KEPT = 2  # candidates per family that get the second round's seeds

# What is varied; networks, and samples per iteration, stay the same. An
# earlier search varied one thing at a time: less entropy was worse for all families, and each preferred
# another KL or gamma than the defaults (docs/decisions.md).
CANDIDATES: dict[str, dict[str, Any]] = {
    "KL 0.005": {"desired_kl": 0.005, "minibatches": 4},
    "KL 0.01": {"desired_kl": 0.01, "minibatches": 4},
    "KL 0.02": {"desired_kl": 0.02, "minibatches": 4},
    "KL 0.02, gamma 0.99": {"desired_kl": 0.02, "gamma": 0.99, "minibatches": 4},
    "KL 0.02, 8 minibatches": {"desired_kl": 0.02, "minibatches": 8},
    "KL 0.02, gamma 0.99, 8 minibatches": {"desired_kl": 0.02, "gamma": 0.99, "minibatches": 8},
}


@dataclass
class Arguments:
    """Search, with the same effort for every family."""

    task: str = "cartpole"
    """What to tune on."""
    families: tuple[str, ...] = FAMILIES
    """One method of each family."""
    steps: int = 2_457_600
    """Environment steps per run."""
    candidates: int = len(CANDIDATES)
    """How many of the candidates, from the first."""
    episodes: int = 200
    """Evaluation episodes per goal."""
    workers: int = os.cpu_count() or 1
    """Runs at a time."""
    folder: Path = Path("runs/tune")
    """Where runs keep checkpoints and logs."""
    output: Path = HERE / "results" / "tuning"
    """Where results go."""


def main(arguments: Arguments) -> int:
    from comparison.study import read  # every run's process imports this file, and has no use for pandas

    check(arguments)
    names = list(CANDIDATES)[: arguments.candidates]
    runs = [make_run(arguments, f, c, seed) for seed in FIRST for f in arguments.families for c in names]
    with RunFolder(arguments.folder):  # two searches must not share their runs
        failed = execute_all(runs, arguments.workers)
        for f in arguments.families:
            best = sorted(names, key=lambda c: -score(runs, f, c))[:KEPT]
            runs += [make_run(arguments, f, c, seed) for seed in MORE for c in best]
        failed += execute_all([run for run in runs if run not in failed], arguments.workers)
    report(failed)
    write(arguments.output, runs, failed, {"workers": arguments.workers}, points=10)
    found = table(read(arguments.output))
    write_whole(arguments.output / "README.md", found)
    print(found)
    return 1 if failed else 0


def check(arguments: Arguments) -> None:
    """Refuse options out of range, and families that are the same.

    Raises:
        ValueError: names the option.
    """
    at_least_one(arguments, "steps", "candidates", "episodes", "workers")
    if arguments.candidates > len(CANDIDATES):
        most = f"at most {len(CANDIDATES)}, which there are"
        raise ValueError(f"expected --candidates of {most}, got {arguments.candidates}")
    different("families", arguments.families, key=Method.parse)


def make_run(arguments: Arguments, family: str, candidate: str, seed: int) -> Run:
    """One run of a candidate, from the task's settings whatever has been tuned already."""
    changes = CANDIDATES[candidate]
    setting = dataclasses.replace(task_setting(arguments.task), tuned={})
    setting = Method.parse(family).configure(setting, seed, arguments.steps, **changes)
    where = arguments.folder / arguments.task / family / candidate.replace(" ", "_") / f"seed_{seed}"
    return Run(arguments.task, f"{family}: {candidate}", seed, setting, where, arguments.episodes)


def score(runs: list[Run], family: str, candidate: str) -> float:
    """Mean evaluated return over the seeds; a run without one counts as the worst."""
    found = [run.result() for run in runs if run.method == f"{family}: {candidate}"]
    rows = [f["evaluation"] if f else [] for f in found]
    each = [[r["return"] for r in row if r["actions"] == "deterministic"] for row in rows]
    return float(np.mean([np.mean(values) if values else -np.inf for values in each]))


def table(study: Study) -> str:
    """Candidates x families: mean evaluated return, and how many seeds it is the mean of."""
    ((task, results),) = study.items()
    returns = {tuple(name.split(": ")): each.returns() for name, each in results.items()}
    families, candidates = (list(dict.fromkeys(names)) for names in zip(*returns, strict=True))
    most = {f: max(len(returns[f, c]) for c in candidates) for f in families}
    best = {
        f: max(returns[f, c].mean() for c in candidates if len(returns[f, c]) == most[f]) for f in families
    }
    rows = []
    for c in candidates:
        rows.append([c])
        for f in families:
            own = returns[f, c]
            mark = "**" * bool(len(own) == most[f] and own.mean() == best[f])
            rows[-1].append(f"{mark}{own.mean():.3f} ({len(own)}){mark}")
    commits = ", ".join(study.about["revisions"])
    text = f"Made by `{study.about['command']}` ({commits}): mean evaluated return of {task} and, in "
    text += f"brackets, the number of\nseeds; the first {len(FIRST)} are the same for all, the best {KEPT} "
    text += f"of a family got {len(MORE)} more. Bold: the winner among those.\n\n"
    return text + markdown(["candidate", *families], rows)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments)))
