"""Tables of tasks that succeed or fail: Table I with successes, and what the time of training went into."""

import numpy as np

from comparison.intervals import estimate
from comparison.methods import label
from comparison.reruns import marked
from comparison.study import Study
from comparison.tables import (
    chance_variation,
    efficiency_table,
    footnotes,
    last_symmetry_loss,
    markdown,
    seconds_per_step,
    seeds_of,
    table_1,
    variation,
)

TITLES = {"deterministic": "mean actions", "sampled": "sampled actions, as in training"}


def tables(study: Study) -> str:
    """All tables of a study, of robots or not."""
    text = f"Made by `{study.about['command']}` at {', '.join(study.about['revisions'])}, "
    text += f"{study.about['machine']}, {study.about['workers']} runs at a time.\n"
    for task in study.tasks:
        body = success_tables(study, task) if has_success(study, task) else table_1(study, task)
        text += f"\n## {task}\n\n{body}\n{efficiency_table(study, task)}"
        if has_split(study, task):
            text += f"\n{throughput_table(study, task)}"
    return text


def success_tables(study: Study, task: str, methods: list[str] | None = None) -> str:
    """A table per evaluation and kind of actions."""
    text = ""
    for what in study.evaluations(task):
        for actions, name in TITLES.items():
            title = name if what == "task" else f"{what}, {name}"
            text += f"{title[0].upper()}{title[1:]}:\n\n"
            text += success_table(study, task, methods, actions, what) + "\n"
    return text + (
        "Interquartile means over seeds, in brackets their 95 % bootstrap intervals; of three seeds, that\n"
        "is the mean, the lowest and the highest. *worst goal*: the lowest success of a seed's goals.\n"
        "*spread*: the largest difference between a seed's goals. Starts are paired, so that an\n"
        "equivariant policy differs by nothing; another policy, or sampled actions, differ also by\n"
        "*chance*: by about so many points if all goals are alike and episodes independent. *task\n"
        "return*: without terms of gait and effort. *turning*: yaw travelled in an episode, where a task\n"
        "measures it. *symmetry loss*: as in the paper, on the states of the last iteration.\n"
    )


def success_table(
    study: Study,
    task: str,
    methods: list[str] | None = None,
    actions: str = "deterministic",
    what: str | None = None,
) -> str:
    """Success, task return and return of every method, each with its spread over the goals.

    Args:
        study: the results.
        task: one of its tasks.
        methods: rows; all by default.
        actions: `deterministic` (mean actions) or `sampled`.
        what: one of the task's evaluations; the first by default.
    """
    rows = [success_row(study, task, method, actions, what) for method in methods or study.methods(task)]
    shown = list(dict.fromkeys(name for row in rows for name in row))
    head = [shown, ["---", *["---:"] * (len(shown) - 1)]]
    body = [[row.get(name, "-") for name in shown] for row in rows]
    return markdown(head + body) + footnotes(body)


def success_row(
    study: Study, task: str, method: str, actions: str = "deterministic", what: str | None = None
) -> dict[str, str]:
    """A row of :func:`success_table`, by column."""
    row = {"method": marked(study, task, method), "seeds": seeds_of(study, task, method)}
    figures = {
        column: study.goal_returns(task, method, column, actions, what)[1]
        for column in ("success", "task_return", "return", "turning")
    }
    if not len(figures["success"]):  # it diverged before its first checkpoint
        return row
    success = 100 * figures["success"]
    row["success [%]"] = estimate(success.mean(axis=1)).format(1)
    row["worst goal [%]"] = estimate(success.min(axis=1)).format(1)
    row["spread [%]"] = estimate(variation(success)).format(1)
    chance = chance_variation(figures["success"], min(study.about["episodes"]))
    row["chance [%]"] = f"{100 * chance.mean():.1f}"
    for column, name in (("task_return", "task return"), ("return", "return")):
        if np.isfinite(figures[column]).all():
            row[name] = estimate(figures[column].mean(axis=1)).format(2)
            row[f"spread of {name}"] = estimate(variation(figures[column])).format(2)
    row["symmetry loss"] = last_symmetry_loss(study, task, method)
    if np.isfinite(figures["turning"]).any():
        row["turning [rad]"] = estimate(figures["turning"].mean(axis=1)).format(2)
    return row


def has_success(study: Study, task: str) -> bool:
    """Whether episodes of a task succeed or fail."""
    return any(row["task"] == task and row.get("success") is not None for row in study.runs)


def has_split(study: Study, task: str) -> bool:
    """Whether it was logged what the time of a task's training went into."""
    return any(np.isfinite(c.get("physics_seconds", np.nan)).any() for c in study.curves_of_task(task))


def throughput_table(study: Study, task: str) -> str:
    """Environment steps per second, learning included, and what the time goes into."""
    rows = [["method", "steps per second", "physics", "inference, rewards, resets", "updates and the rest"]]
    rows.append(["---", *["---:"] * 4])
    for method in study.methods(task):
        parts = [_split(c) for c in study.curves_of(task, method).values()]
        every = np.concatenate([np.zeros((3, 0)), *parts], axis=1)
        if not every.shape[1]:
            rows.append([label(method), *["-"] * 4])
            continue
        shares = every.sum(axis=1) / every.sum()
        rate = 1 / seconds_per_step(study, task, method)
        rows.append([label(method), f"{rate:,.0f}", *(f"{share:.0%}" for share in shares)])
    note = (
        "Of all seeds, each a process with one thread beside as many others as ran at a time; steps per\n"
        "second are the median over logged iterations, shares are of the sum.\n"
        "*updates and the rest*: all that is not the collection of data.\n"
    )
    return markdown(rows) + "\n" + note


def _split(curve: dict[str, np.ndarray]) -> np.ndarray:
    """Seconds of physics, the rest of the collection, and the rest, ``(3, intervals)``."""
    whole = np.diff(curve["seconds"]) / np.diff(curve["frames"])
    same = np.diff(curve.get("stage", np.zeros(len(curve["frames"])))) == 0
    steps = (np.diff(curve["frames"]) / np.maximum(np.diff(curve["iteration"]), 1))[same]
    each = whole[same] * steps  # seconds of an iteration
    physics, collect = (curve[f"{name}_seconds"][1:][same] for name in ("physics", "collect"))
    split = np.stack([physics, collect - physics, each - collect])
    return split[:, np.isfinite(split).all(axis=0)]
