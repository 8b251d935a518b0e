"""Writes the results of a comparison: two tidy tables and a description, from which all else is drawn.

* `runs.csv`: a row per run, evaluated task, kind of actions (mean or sampled) and goal.
* `curves.csv`: a row per run and logged iteration of the training.
* `study.json`: the command that was given (until c5f032c without its `--collect` and `--extend`), commits,
  versions, machines; hyper-parameters per task and method; what failed; what the tables hold, so that one
  which has lost rows is noticed.
* `policies/TASK/METHOD`: the policy of the seed with the highest evaluated return, for tasks that
  succeed or fail; `examples/watch.py` and `behaviour.py` read it.

`study.py` reads them.
"""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from filelock import FileLock

from comparison.files import digest, stage, write_json
from comparison.provenance import command, joint_origin, revision
from comparison.records import (
    CURVE,
    EVALUATION,
    RUN,
    TABLES,
    EarlierResults,
    Record,
    finish_writing,
    from_folder,
    policy_folder,
    score,
)
from comparison.run import Run
from torchrl_sym.recipes import export_actor

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
    with FileLock(folder / ".lock"):  # others who write here wait
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
