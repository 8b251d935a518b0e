"""The results of a comparison, read back: `study[task][method]` is what the seeds of one method did.

Tables, claims and figures ask it for numbers of all seeds: of `runs.csv` for evaluated returns, their
variation between equivalent goals, successes; of `curves.csv` for what happened while training. Both are
pandas frames. Numbers that many ask for are worked out once; a study is not changed after it was read.
"""

from __future__ import annotations

import io
from collections import defaultdict
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from comparison.corrections import corrected
from comparison.intervals import iqm
from comparison.methods import Method
from comparison.progress import SHARE, SMOOTHING, crossing, has_curriculum, recovery, smooth, with_progress
from comparison.records import CURVE, EVALUATION, RUN, TABLES, read_about, text_of

TEXT = ("task", "method", "outcome", "revision", "what", "actions", "goal")
"""Columns that hold no numbers."""
NUMBERS = ("return", "task_return", "success", "turning")
"""Columns of `runs.csv` that figures are drawn of; a table that has none is filled with NaN."""
LEAST = 1e-12  # of a symmetry loss whose logarithm is taken


class Study(Mapping[str, "TaskResults"]):
    """Results of all tasks, in the order in which they were asked for.

    Args:
        about: `study.json`.
        runs: rows of `runs.csv`.
        curves: rows of `curves.csv`.
    """

    def __init__(self, about: dict[str, Any], runs: pd.DataFrame, curves: pd.DataFrame) -> None:
        self.about = about
        self.runs = _with_columns(runs, (*RUN, "outcome", *EVALUATION, *NUMBERS))
        self.curves = _with_columns(curves, (*RUN, *CURVE))
        self._tasks = {name: TaskResults(self, name) for name in about["methods"]}

    def __getitem__(self, task: str) -> TaskResults:
        return self._tasks[task]

    def __iter__(self) -> Iterator[str]:
        return iter(self._tasks)

    def __len__(self) -> int:
        return len(self._tasks)

    @property
    def trained(self) -> int:
        """How many runs have a curve."""
        return self.curves.groupby([*RUN]).ngroups

    @property
    def hours(self) -> float:
        """Hours of training, of all runs together."""
        return float(self.curves.groupby([*RUN], sort=False)["seconds"].last().sum()) / 3600

    @property
    def million_steps(self) -> float:
        """Environment steps of the longest run."""
        return float(self.curves["frames"].max()) / 1e6


class TaskResults(Mapping[str, "MethodResults"]):
    """Results of all methods on one task, in the order of the study."""

    def __init__(self, study: Study, name: str) -> None:
        self.study = study
        self.name = name
        self.runs = study.runs[study.runs["task"] == name]
        self.curves = study.curves[study.curves["task"] == name]
        self._methods = {method: MethodResults(self, method) for method in study.about["methods"][name]}

    def __getitem__(self, method: str) -> MethodResults:
        return self._methods[method]

    def __iter__(self) -> Iterator[str]:
        return iter(self._methods)

    def __len__(self) -> int:
        return len(self._methods)

    @property
    def evaluations(self) -> list[str]:
        """What was evaluated after training, in order."""
        return list(self.runs["what"].dropna().unique())

    @property
    def has_success(self) -> bool:
        """Whether episodes succeed or fail."""
        return bool(self.runs["success"].notna().any())

    @property
    def has_split(self) -> bool:
        """Whether it was logged what the time of training went into."""
        return bool(np.isfinite(self.curves["physics_seconds"]).any())

    @property
    def has_phases(self) -> bool:
        """Whether the curriculum has phases."""
        return bool(np.isfinite(self.curves["phase"]).any())

    @property
    def has_curriculum(self) -> bool:
        """Whether some run has levels and successes."""
        return any(has_curriculum(curve) for each in self.values() for curve in each.curves.values())

    @property
    def measured(self) -> str:
        """What tells how far a training has come; see `progress.py`."""
        return "level times success rate" if self.has_curriculum else "training return"

    @cached_property
    def threshold(self) -> float:
        """A progress that a good run makes, well above the first value."""
        first, last = [], []
        for results in self.values():
            curve = results.curve("progress")
            known = curve[np.isfinite(curve).all(axis=1)].to_numpy()
            if known.size:
                first.append(iqm(known[0]))
                last.append(iqm(known[-1]))
        return float((1 - SHARE) * np.min(first) + SHARE * np.max(last)) if first else float("nan")


class MethodResults:
    """What the seeds of one method did on one task.

    Attributes:
        task: the results that it is part of.
        name: the method's, as in the tables.
        stages: what each stage was trained with, of `study.json`.
    """

    def __init__(self, task: TaskResults, name: str) -> None:
        self.task = task
        self.name = name
        self.stages: list[dict[str, Any]] = task.study.about["methods"][task.name][name] or []
        self._runs = task.runs[task.runs["method"] == name]
        own = task.curves[task.curves["method"] == name].drop(columns=["task", "method"])
        self.curves: dict[int, pd.DataFrame] = {seed: c for seed, c in own.groupby("seed", sort=False)}

    @cached_property
    def method(self) -> Method:
        """The method, parsed."""
        return Method.parse(self.name)

    @property
    def label(self) -> str:
        """How figures and tables call the method."""
        return self.method.label

    @property
    def seeds(self) -> list[int]:
        """Seeds that ended, also those that diverged."""
        return list(self._runs["seed"].unique())

    @property
    def diverged(self) -> set[int]:
        """Seeds that ended in numbers that are not finite."""
        return set(self._runs["seed"][self._runs["outcome"] == "diverged"])

    def evaluated(
        self, column: str = "return", actions: str = "deterministic", what: str | None = None
    ) -> pd.DataFrame:
        """A figure of every seed (rows) on every equivalent goal (columns).

        Args:
            column: of `runs.csv`: `return`, `task_return`, `success`, `turning`.
            actions: `deterministic` (mean actions) or `sampled`.
            what: one of the task's evaluations; the first by default.
        """
        what = what or next(iter(self.task.evaluations), None)
        rows = self._runs[(self._runs["actions"] == actions) & (self._runs["what"] == what)]
        table = rows.pivot(index="seed", columns="goal", values=column)
        return table.reindex(index=rows["seed"].unique(), columns=rows["goal"].unique())

    def returns(self, column: str = "return", **which: str | None) -> np.ndarray:
        """Mean over the goals, or that of another figure, ``(seeds,)``; see :meth:`evaluated`."""
        return self.evaluated(column, **which).to_numpy().mean(axis=1)

    def variation(self, column: str = "return", **which: str | None) -> np.ndarray:
        """Largest difference between two goals, ``(seeds,)``; see :meth:`evaluated`."""
        values = self.evaluated(column, **which).to_numpy()
        return values.max(axis=1) - values.min(axis=1)

    def chance_variation(self, what: str | None = None, actions: str = "deterministic") -> np.ndarray:
        """Variation of success that chance explains, at most, ``(seeds,)``."""
        rates = self.evaluated("success", actions, what).to_numpy()
        return chance_variation(rates, min(self.task.study.about["episodes"]))

    @cached_property
    def progress(self) -> dict[int, pd.DataFrame]:
        """Curves as far as `progress` goes, by seed; see `progress.with_progress`."""
        return {seed: with_progress(curve, self.stages) for seed, curve in self.curves.items()}

    def curve(self, column: str) -> pd.DataFrame:
        """A column of `curves.csv`, or `progress`, over million steps: a column per seed.

        At every point, a seed's value is its latest. So one that diverged keeps its last, and is not
        dropped from the average; one that diverged before it had a value is.
        """
        own = self.progress if column == "progress" else self.curves
        if not own:
            return pd.DataFrame()
        steps = max((c["frames"] for c in own.values()), key=lambda frames: frames.iloc[-1])
        latest = [c.set_index("frames")[column].reindex(steps, method="ffill") for c in own.values()]
        table = pd.concat(latest, axis=1, keys=own).set_index(steps.to_numpy() / 1e6)
        return table.loc[:, np.isfinite(table.iloc[-1])]

    @property
    def symmetry_loss(self) -> np.ndarray:
        """Decimal logarithm of the last symmetry loss of every seed."""
        curve = self.curve("mirror_loss").to_numpy()
        return np.log10(np.maximum(curve[-1], LEAST)) if curve.size else np.zeros(0)

    @property
    def last_symmetry_loss(self) -> str:
        """The interquartile mean of its logarithm, as a number of ordinary size."""
        return f"{10 ** iqm(losses):.2g}" if len(losses := self.symmetry_loss) else "-"

    @property
    def seconds_per_step(self) -> float:
        """Wall-clock seconds per environment step: the median over all logged intervals of all seeds."""
        costs = [np.diff(c["seconds"]) / np.diff(c["frames"]) for c in self.curves.values()]
        every = np.concatenate([np.zeros(0), *costs])
        return float(np.median(every)) if len(every) else float("nan")

    @cached_property
    def crossings(self) -> np.ndarray:
        """Million steps and seconds until each seed gets to the task's threshold, ``(seeds, 2)``."""
        found = [crossing(self.progress.get(seed), self.task.threshold) for seed in self.seeds]
        return np.array(found).reshape(-1, 2)

    @property
    def reached(self) -> tuple[int, int]:
        """How many seeds reach the threshold, and how many there are."""
        return int(np.isfinite(self.crossings[:, 0]).sum()), len(self.crossings)

    @property
    def steps(self) -> np.ndarray:
        """Million steps to the threshold; seeds that never reach it count as the whole curve."""
        return np.minimum(self.crossings[:, 0], self.curve("progress").index[-1])

    @property
    def own_steps(self) -> np.ndarray:
        """Million steps to `SHARE` of the way to each seed's own last value: speed, wherever it ends."""
        curve = self.curve("progress")
        levels = smooth(curve.to_numpy().T)
        first = np.array([row[np.isfinite(row)][0] for row in levels])
        there = levels >= ((1 - SHARE) * first + SHARE * levels[:, -1])[:, None]
        return curve.index.to_numpy()[SMOOTHING - 1 :][there.argmax(axis=1)]

    @property
    def recoveries(self) -> np.ndarray:
        """Million steps that each seed takes to recover in the last phase; see `progress.recovery`."""
        return np.array([recovery(curve) for curve in self.progress.values()])


def chance_variation(rates: np.ndarray, episodes: int) -> np.ndarray:
    """Variation between goals that succeed equally often, of as many episodes each, by chance.

    Expected range of normal draws with the binomial's deviation. Episodes count as independent, so it is
    more than starts that are paired leave, of which an equivariant policy makes the same.

    Args:
        rates: success rates, ``(seeds, goals)``.
        episodes: of each goal.

    Returns:
        ``(seeds,)``.
    """
    draws = np.random.default_rng(0).normal(size=(20_000, rates.shape[1]))
    mean = rates.mean(axis=1)
    return np.ptp(draws, axis=1).mean() * np.sqrt(mean * (1 - mean) / episodes)


def read(folder: Path) -> Study:
    """Read what `writing.write` wrote, and leave out what it says wrongly (`corrections.py`).

    Raises:
        FileNotFoundError: there are no results.
        Damaged: they are not as they were written.
    """
    about = read_about(folder)
    if not about:
        raise FileNotFoundError(f"expected results in {folder} (study.json), found none; run compare.py")
    kinds: dict[str, Any] = defaultdict(lambda: float, dict.fromkeys(TEXT, str), seed=int)
    how = {"dtype": kinds, "na_values": ["", "nan"], "keep_default_na": False}
    runs, curves = (pd.read_csv(io.StringIO(text_of(folder, name, about)), **how) for name in TABLES)
    return Study(about, runs, corrected(curves, runs))


def _with_columns(table: pd.DataFrame, names: tuple[str, ...]) -> pd.DataFrame:
    """A table that has all of these columns: one that was not written says nothing."""
    return table.reindex(columns=list(dict.fromkeys([*table.columns, *names])))
