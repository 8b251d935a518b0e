"""The results of a comparison on disk: two tidy tables and a description, from which all else is drawn.

* `runs.csv`: a row per run, evaluated task, kind of actions (mean or sampled) and goal.
* `curves.csv`: a row per run and logged iteration of the training.
* `study.json`: the command that was given (until c5f032c without its `--collect` and `--extend`), commits,
  versions, machines; hyper-parameters per task and method; what failed; what the tables hold, so that one
  which has lost rows is noticed.
* `policies/TASK/METHOD`: the policy of the seed with the highest evaluated return, for tasks that
  succeed or fail; `examples/watch.py` and `behaviour.py` read it.
"""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from comparison.corrections import corrected
from comparison.files import digest, locked, stage, write_json
from comparison.provenance import command, joint_origin, revision
from comparison.records import (
    RUN,
    TABLES,
    EarlierResults,
    Record,
    by_run,
    finish_writing,
    from_folder,
    policy_folder,
    read_about,
    rows_of,
    score,
)
from comparison.run import Run
from torchrl_sym.recipes import export_actor

EVALUATION = ("what", "actions", "goal", "return", "task_return", "success")  # then the behaviour
CURVE = (
    *("stage", "iteration", "frames", "seconds", "return", "mirror_loss", "log_prob", "log_prob_copies"),
    *("std", "learning_rate", "kl", "success", "level", "phase", "collect_seconds", "physics_seconds"),
)
LAST_PHASE = 2.0  # of a curriculum in three phases
POINTS = 105  # rows per curve that are kept, at most


def write(
    folder: Path,
    runs: Sequence[Run],
    failed: Sequence[Run],
    about: dict[str, Any],
    points: int = POINTS,
    earlier: EarlierResults | None = None,
) -> None:
    """Write the results of all finished runs.

    Args:
        folder: where to.
        runs: all runs; those that have no result are left out.
        failed: runs that failed, of which nothing is read.
        about: what else goes into `study.json`.
        points: rows per curve that are kept, at most; the last one always is.
        earlier: results with what is known of runs that are not finished in their folder.

    Raises:
        ValueError: the earlier results hold such a run with other settings.
    """
    finished: list[Record] = []
    unfinished: list[str] = []
    policies: dict[Path, list[tuple[float, Path]]] = {}  # scores and checkpoints of each method
    methods: dict[str, dict[str, Any]] = {}
    for run in runs:
        record = None if run in failed else from_folder(run, points)
        record = record or (earlier and earlier.record(run))
        if record is None:
            unfinished += [str(run)] * (run not in failed)
            continue
        finished.append(record)
        methods.setdefault(run.task, {})[run.method] = record.stages
        where, reached = policy_folder(folder, run.task) / run.method, score(record.evaluated)
        if record.checkpoint and reached is not None:
            policies.setdefault(where, []).append((reached, record.checkpoint))
    for where, scored in policies.items():
        _, best = max(scored, key=lambda pair: pair[0])
        if best != where:
            export_actor(best, where)
    evaluated = [row for record in finished for row in record.evaluated]
    first = (*RUN, "outcome", "revision", "frames", "seconds", *EVALUATION)
    behaviour = dict.fromkeys(key for row in evaluated for key in row if key not in first)
    curves = [row for record in finished for row in record.curve]
    tables = (_table((*first, *behaviour), evaluated), _table((*RUN, *CURVE), curves))
    origins = [each for record in finished for each in record.origins]
    episodes = sorted({record.episodes for record in finished})
    collected = {"command": command(), "collected_at": revision(), "episodes": episodes}
    about = collected | joint_origin(origins) | about
    about |= {"failed": [str(run) for run in failed], "methods": methods, "unfinished": unfinished}
    _write_all(folder, about, dict(zip(TABLES, tables, strict=True)))


def _write_all(folder: Path, about: dict[str, Any], tables: dict[str, str]) -> None:
    """Replace the description and its tables in one moment: that of the description."""
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        finish_writing(folder)
        for name, text in tables.items():
            stage(folder / name, text)
        described = {name: digest(text) for name, text in tables.items()}
        write_json(folder / "study.json", about | {"tables": described})
        finish_writing(folder)


def _table(columns: Sequence[str], rows: Sequence[dict[str, Any]]) -> str:
    used = [name for name in columns if any(row.get(name) is not None for row in rows)]
    file = io.StringIO()
    writer = csv.DictWriter(file, used, extrasaction="ignore", restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: _short(value) for key, value in row.items()} for row in rows)
    return file.getvalue()


def _short(value: Any) -> Any:
    return f"{value:.6g}" if isinstance(value, float) else value


@dataclass(frozen=True)
class Study:
    """Results, read back.

    Attributes:
        about: `study.json`.
        runs: rows of `runs.csv`; numbers as floats, None where empty.
        curves: columns of `curves.csv` by (task, method, seed), `corrected`.
    """

    about: dict[str, Any]
    runs: list[dict[str, Any]]
    curves: dict[tuple[str, str, int], dict[str, np.ndarray]]

    @property
    def tasks(self) -> list[str]:
        """Tasks, in the order of the study."""
        return list(self.about["methods"])

    def methods(self, task: str) -> list[str]:
        """Methods of a task, in the order of the study."""
        return list(self.about["methods"].get(task, {}))

    def seeds(self, task: str, method: str) -> list[int]:
        """Seeds of a method."""
        return list(dict.fromkeys(row["seed"] for row in self._rows(task, method)))

    def curve(self, task: str, method: str, column: str) -> tuple[np.ndarray, np.ndarray]:
        """Million steps ``(points,)`` and a column of all seeds ``(seeds, points)``.

        The column `progress` is the training return, or where there is a curriculum, in which returns fall
        as tasks get harder, the level times the success rate: zero before the last phase and the last task
        of the curriculum, and not continued once training leaves it for the last level alone. At every
        point, a seed's value is its latest. So one that diverged keeps its last, and is not dropped from
        the average; one that diverged before it had a value is.
        """
        own = self.with_progress if column == "progress" else self.curves_of
        columns = list(own(task, method).values())
        if not columns:
            return np.zeros(0), np.zeros((0, 0))
        steps = max(columns, key=lambda c: c["frames"][-1])["frames"]
        values = []
        for c in columns:
            latest = np.searchsorted(c["frames"], steps, side="right") - 1
            logged = c.get(column, np.full(len(c["frames"]), np.nan))
            values.append(np.where(latest < 0, np.nan, logged[latest]))
        values = np.array(values)
        return steps / 1e6, values[np.isfinite(values[:, -1])]

    def with_progress(self, task: str, method: str) -> dict[int, dict[str, np.ndarray]]:
        """Columns of a method's curves as far as `progress` goes, by seed; see :meth:`curve`."""
        stages = self.about["methods"].get(task, {}).get(method) or []
        return {seed: add_progress(c, stages) for seed, c in self.curves_of(task, method).items()}

    def evaluations(self, task: str) -> list[str]:
        """What was evaluated after training on a task, in order."""
        return list(dict.fromkeys(r["what"] for r in self.runs if r["task"] == task and r.get("what")))

    def goal_returns(
        self,
        task: str,
        method: str,
        column: str = "return",
        actions: str = "deterministic",
        what: str | None = None,
    ) -> tuple[list[str], np.ndarray]:
        """Names of the goals, and their mean returns ``(seeds, goals)``, or another column of `runs.csv`.

        Args:
            task: a task of the study.
            method: one of its methods.
            column: `return`, `task_return`, `success`, `turning`.
            actions: `deterministic` (mean actions) or `sampled`.
            what: one of the task's evaluations; the first by default.
        """
        what = what or next(iter(self.evaluations(task)), None)
        rows = self._rows(task, method)
        rows = [r for r in rows if r.get("actions") == actions and r.get("what") == what]
        goals = list(dict.fromkeys(r["goal"] for r in rows))
        seeds = list(dict.fromkeys(r["seed"] for r in rows))
        found = {(r["seed"], r["goal"]): r.get(column) for r in rows}
        values = [[math.nan if found[s, g] is None else found[s, g] for g in goals] for s in seeds]
        return goals, np.array(values).reshape(len(seeds), len(goals))

    def diverged(self, task: str, method: str) -> set[int]:
        """Seeds of a method that ended in numbers that are not finite."""
        return {r["seed"] for r in self._rows(task, method) if r["outcome"] == "diverged"}

    def curves_of(self, task: str, method: str) -> dict[int, dict[str, np.ndarray]]:
        """Columns of a method's curves, by seed."""
        return {seed: c for (t, m, seed), c in self.curves.items() if (t, m) == (task, method)}

    def curves_of_task(self, task: str) -> list[dict[str, np.ndarray]]:
        """Columns of all curves of a task."""
        return [c for (t, _, _), c in self.curves.items() if t == task]

    def _rows(self, task: str, method: str) -> list[dict[str, Any]]:
        return [row for row in self.runs if (row["task"], row["method"]) == (task, method)]


def has_curriculum(curve: dict[str, np.ndarray]) -> bool:
    """Whether a run has levels and successes."""
    return all(np.isfinite(curve.get(name, np.nan)).any() for name in ("level", "success"))


def add_progress(curve: dict[str, np.ndarray], stages: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """A run's curve, as long as there is a curriculum, with a column `progress`; see `Study.curve`.

    Args:
        curve: columns of the run.
        stages: what each stage trained with, of `study.json`; empty for one task throughout.
    """
    if not has_curriculum(curve):
        return curve | {"progress": curve["return"]}
    counts = np.ones(len(curve["frames"]))
    if "phase" in curve:
        counts *= np.nan_to_num(curve["phase"], nan=LAST_PHASE) == LAST_PHASE
    tasks = [stage["task"] for stage in stages]
    rising = [number for number, task in enumerate(tasks) if task.get("curriculum", True)]
    if rising:
        last = [number for number in rising if tasks[number] == tasks[rising[-1]]]
        counts *= np.isin(curve["stage"], last)
        curve = {name: values[curve["stage"] <= last[-1]] for name, values in curve.items()}
        counts = counts[: len(curve["frames"])]
    return curve | {"progress": curve["level"] * curve["success"] * counts}


def read(folder: Path) -> Study:
    """Read what `write` wrote.

    Raises:
        FileNotFoundError: there are no results.
        Damaged: they are not as they were written.
    """
    about = read_about(folder)
    if not about:
        raise FileNotFoundError(f"expected results in {folder} (study.json), found none; run compare.py")
    runs, rows = (rows_of(folder, name, about) for name in TABLES)
    revisions = {key: each[0].get("revision", "") for key, each in by_run(runs).items()}
    curves = {key: corrected(_columns(own), revisions[key]) for key, own in by_run(rows).items()}
    return Study(about, [{key: _number(value) for key, value in row.items()} for row in runs], curves)


def _columns(rows: Sequence[dict[str, str]]) -> dict[str, np.ndarray]:
    return {
        name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0] if name not in RUN
    }


def _number(text: str) -> Any:
    if text == "":
        return None
    try:
        value = float(text)
    except ValueError:
        return text
    return int(value) if value.is_integer() and text.lstrip("-").isdigit() else value
