"""What the results of a comparison say about one run: read from the run's folder, or from earlier results.

A run's folder is large and stays on the machine that trained it; results are small and shared. So that a
comparison can be extended anywhere, the runs that its results hold need no folder, if they were made with
the very settings that are asked for.
"""

import contextlib
import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from comparison.files import Damaged, Kind, finish, read_json, read_table
from comparison.run import Run, completed, last_checkpoint

RUN = ("task", "method", "seed")
EVALUATION = ("what", "actions", "goal", "return", "task_return", "success")  # then the behaviour
CURVE = (
    *("stage", "iteration", "frames", "seconds", "return", "mirror_loss", "log_prob", "log_prob_copies"),
    *("std", "learning_rate", "kl", "success", "level", "phase", "collect_seconds", "physics_seconds"),
)
TABLES = ("runs.csv", "curves.csv")
ABOUT: dict[str, Kind] = {"methods": dict, "command": str, "versions": dict, "machine": str}
RESTORE = "restore it, such as by `git checkout`, or delete the folder and --collect again"


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

    Raises:
        Damaged: its metrics are not those that led to its result.
    """
    result = run.result()
    if result is None:
        return None
    name = dict(zip(RUN, (run.task, run.method, run.seed), strict=True))
    ended = {key: result[key] for key in ("outcome", "frames", "seconds")}
    ended["outcome"] = ended["outcome"].split(":")[0]
    ended["revision"] = " ".join(each["revision"] for each in result["origins"])
    curve = run.curve(result)
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
        folder: where `writing.write` has written; there may be nothing yet.

    Raises:
        Damaged: a file of the results is not as it was written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.about = read_about(folder)
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
        same = _without_seed(completed(stages or [])) == _without_seed(asked["stages"])
        same = same and episodes == [run.episodes]
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
        grouped: dict[tuple[str, str, int], list[dict[str, str]]] = {}
        for row in rows_of(self.folder, name, self.about) if self.about else []:
            key = (row["task"], row["method"], int(row["seed"]))
            grouped.setdefault(key, []).append({column: text for column, text in row.items() if text})
        return grouped


def score(evaluated: Sequence[dict[str, Any]]) -> float | None:
    """Mean return over evaluations and goals, mean actions; None for what does not succeed or fail."""
    rows = [row for row in evaluated if row.get("success") is not None]
    returns = [float(row["return"]) for row in rows if row["actions"] == "deterministic"]
    return float(np.mean(returns)) if returns else None


def policy_folder(folder: Path, task: str) -> Path:
    """Where the results in a folder keep the policies of a task, a folder per method."""
    return folder / "policies" / task.replace(":", ".")


def read_about(folder: Path) -> dict[str, Any]:
    """The description of results, `study.json`; empty if there is none.

    Raises:
        Damaged: it is not as it was written.
    """
    path = folder / "study.json"
    about = read_json(path, ABOUT, RESTORE)
    tables = about.get("tables")
    if about and not isinstance(tables, dict):
        raise Damaged(
            f"expected {path} to say what its tables hold (`tables`), got nothing; if they are whole, run "
            f"python benchmarks/seal.py {folder.name}"
        )
    return about


def rows_of(folder: Path, name: str, about: dict[str, Any]) -> list[dict[str, str]]:
    """Rows of a table of the results; see :func:`text_of`."""
    return list(csv.DictReader(io.StringIO(text_of(folder, name, about))))


def text_of(folder: Path, name: str, about: dict[str, Any]) -> str:
    """A table of the results, which must be as it was written.

    Raises:
        Damaged: it is another one, or `study.json` knows none of that name.
    """
    expected = about["tables"].get(name)
    if not isinstance(expected, dict) or {"rows", "sha256"} - expected.keys():
        raise Damaged(f"expected {folder / 'study.json'} to describe {name}, got {expected!r}; {RESTORE}")
    return read_table(folder / name, expected, RESTORE)


def finish_writing(folder: Path) -> None:
    """Put tables that a description of results names by content in their places.

    What describes nothing, or is damaged, is for the next content to replace.
    """
    with contextlib.suppress(Damaged):
        tables = read_about(folder).get("tables", {})
        for name in TABLES:
            finish(folder / name, tables.get(name))


def _without_seed(stages: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [
        stage | {"config": {k: v for k, v in stage["config"].items() if k != "seed"}} for stage in stages
    ]
