"""What the results of a comparison say about one run: read from the run's folder, or from earlier results.

A run's folder is large and stays on the machine that trained it; results are small and shared. So that a
comparison can be extended anywhere, the runs that its results hold need no folder, if they were made with
the very settings that are asked for.
"""

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from comparison.run import Run, last_checkpoint, read_curve

RUN = ("task", "method", "seed")


@dataclass(frozen=True)
class Record:
    """One finished run.

    Attributes:
        evaluated: its rows of `runs.csv`.
        curve: its rows of `curves.csv`.
        origins: the code that it was trained with, see `provenance.origin`.
        stages: its settings, without the seed.
        episodes: evaluation episodes per goal.
        checkpoint: where its policy is; None if there is none, or if results keep that of another seed.
    """

    evaluated: list[dict[str, Any]]
    curve: list[dict[str, Any]]
    origins: list[dict[str, Any]]
    stages: list[dict[str, Any]]
    episodes: int
    checkpoint: Path | None


def from_folder(run: Run, points: int) -> Record | None:
    """The record of a run that is finished in its folder; None if it is not.

    Args:
        run: the run.
        points: rows of its curve that are kept, at most; the last one always is.
    """
    result = run.result()
    if result is None:
        return None
    name = dict(zip(RUN, (run.task, run.method, run.seed), strict=True))
    ended = {key: result[key] for key in ("outcome", "frames", "seconds")}
    ended["outcome"] = ended["outcome"].split(":")[0]
    ended["revision"] = " ".join(each["revision"] for each in result["origins"])
    curve = read_curve(run.folder)
    every = math.ceil(run.iterations / points)  # not of what there is: all seeds keep the same iterations
    return Record(
        evaluated=[name | ended | row for row in result["evaluation"] or [{}]],
        curve=[
            name | row for number, row in enumerate(curve, 1) if number % every == 0 or number == len(curve)
        ],
        origins=result["origins"],
        stages=_without_seed(result["stages"]),
        episodes=result["episodes"],
        checkpoint=last_checkpoint(run.folder),
    )


class EarlierResults:
    """Results that were written before, run by run.

    Args:
        folder: where `study.write` has written; there may be nothing yet.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        about = folder / "study.json"
        self.about: dict[str, Any] = json.loads(about.read_text()) if about.exists() else {}
        self._evaluated = self._by_run("runs.csv")
        self._curves = self._by_run("curves.csv")

    def record(self, run: Run) -> Record | None:
        """The record of a run; None if the results do not hold it.

        Raises:
            ValueError: they hold it with other settings.
        """
        key = (run.task, run.method, run.seed)
        if key not in self._evaluated:
            return None
        rows, asked = self._evaluated[key], run.request()
        stages = self.about.get("methods", {}).get(run.task, {}).get(run.method)
        episodes = self.about.get("episodes")
        evaluations = {row["what"] for row in rows if "what" in row}
        same = stages == _without_seed(asked["stages"]) and episodes == [run.episodes]
        if not same or evaluations - asked["evaluations"].keys():
            raise ValueError(
                f"expected {self.folder} to hold {run} as it is asked for now, got other settings "
                "(study.json); use another --name, or train it again"
            )
        here = {name: self.about[name] for name in ("versions", "machine")}
        return Record(
            evaluated=rows,
            curve=self._curves.get(key, []),
            origins=[here | {"revision": revision} for revision in rows[0]["revision"].split()],
            stages=stages,
            episodes=run.episodes,
            checkpoint=self._policy(run),
        )

    def _policy(self, run: Run) -> Path | None:
        """Where the policy of a run is, if it was the best of its method."""
        folder = policy_folder(self.folder, run.task) / run.method
        scores = {
            seed: score(rows)
            for (task, method, seed), rows in self._evaluated.items()
            if (task, method) == (run.task, run.method)
        }
        best = max(scores, key=lambda seed: -math.inf if scores[seed] is None else scores[seed])
        return folder if folder.exists() and best == run.seed else None

    def _by_run(self, name: str) -> dict[tuple[str, str, int], list[dict[str, str]]]:
        """Rows of a table for every run, without empty entries."""
        table = by_run(self.folder / name) if self.about else {}
        return {
            key: [{column: text for column, text in row.items() if text} for row in rows]
            for key, rows in table.items()
        }


def score(evaluated: Sequence[dict[str, Any]]) -> float | None:
    """Mean return over evaluations and goals, mean actions; None for what does not succeed or fail."""
    rows = [row for row in evaluated if row.get("success") is not None]
    returns = [float(row["return"]) for row in rows if row["actions"] == "deterministic"]
    return float(np.mean(returns)) if returns else None


def policy_folder(folder: Path, task: str) -> Path:
    """Where the results in a folder keep the policies of a task, a folder per method."""
    return folder / "policies" / task.replace(":", ".")


def read_table(path: Path) -> list[dict[str, str]]:
    """Rows of a table of the results."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def by_run(path: Path) -> dict[tuple[str, str, int], list[dict[str, str]]]:
    """Rows of a table of the results by task, method and seed."""
    grouped: dict[tuple[str, str, int], list[dict[str, str]]] = {}
    for row in read_table(path):
        grouped.setdefault((row["task"], row["method"], int(row["seed"])), []).append(row)
    return grouped


def _without_seed(stages: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [
        stage | {"config": {k: v for k, v in stage["config"].items() if k != "seed"}} for stage in stages
    ]
