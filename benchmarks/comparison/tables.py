"""The numbers of a comparison as Markdown: Table I of the paper, successes, and how fast each method is."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np
import pandas as pd

from comparison.intervals import estimate
from comparison.markdown import markdown
from comparison.progress import SHARE, SMOOTHING
from comparison.reruns import footnote, marked
from comparison.study import MethodResults, Study, TaskResults

TITLES = {"deterministic": "mean actions", "sampled": "sampled actions, as in training"}


def tables(study: Study) -> str:
    """All tables of a study."""
    text = f"Made by `{study.about['command']}` at {', '.join(study.about['revisions'])}, "
    text += f"{study.about['machine']}, {study.about['workers']} runs at a time.\n"
    for name, task in study.items():
        body = success_tables(task) if task.has_success else table_1(task)
        text += f"\n## {name}\n\n{body}\n{efficiency_table(task)}"
        if task.has_split:
            text += f"\n{throughput_table(task)}"
    return text


def table_1(task: TaskResults, methods: Sequence[str] | None = None) -> str:
    """Return and variation between equivalent goals, per method (the paper's Table I)."""
    head = ["method", "seeds", "return", "variation", "largest variation", "symmetry loss"]
    rows = []
    for results in (task[name] for name in methods or task):
        row = [marked(results), seeds_of(results)]
        returns = results.evaluated()
        if returns.empty:
            rows.append([*row, *["-"] * (len(head) - 2)])
            continue
        row += [estimate(results.returns()).format(), "-", "-", results.last_symmetry_loss]
        if returns.shape[1] > 1:
            row[3:5] = [estimate(results.variation()).format(), f"{results.variation().max():.3f}"]
        rows.append(row)
    note = (
        "*return*: mean over the equivalent goals, mean actions; *variation*: the largest difference\n"
        "between two goals; both as interquartile mean over seeds with its 95 % bootstrap interval.\n"
        "*largest variation*: that of the worst seed. *symmetry loss*: sum over the group of the squared\n"
        "distance of K_g[π(s)] from π(L_g[s]) on the states of the last iteration (interquartile mean of\n"
        "logarithms).\n"
    )
    return markdown(head, rows) + "\n" + note + footnotes(rows)


def success_tables(task: TaskResults) -> str:
    """A table per evaluation and kind of actions."""
    text = ""
    for what in task.evaluations:
        for actions, name in TITLES.items():
            title = name if what == "task" else f"{what}, {name}"
            text += f"{title[0].upper()}{title[1:]}:\n\n{success_table(task, actions, what)}\n"
    return text + (
        "Interquartile means over seeds, in brackets their 95 % bootstrap intervals; of three seeds, that\n"
        "is the mean, the lowest and the highest. *worst goal*: the lowest success of a seed's goals.\n"
        "*spread*: the largest difference between a seed's goals. Starts are paired, so that an\n"
        "equivariant policy differs by nothing; another policy, or sampled actions, differ also by\n"
        "*chance*: by about so many points if all goals are alike and episodes independent. *task\n"
        "return*: without terms of gait and effort. *turning*: yaw travelled in an episode, where a task\n"
        "measures it. *symmetry loss*: as in the paper, on the states of the last iteration.\n"
    )


def success_table(task: TaskResults, actions: str = "deterministic", what: str | None = None) -> str:
    """Success, task return and return of every method, each with its spread over the goals."""
    rows = [success_row(results, actions, what) for results in task.values()]
    head = list(dict.fromkeys(name for row in rows for name in row))
    body = [[row.get(name, "-") for name in head] for row in rows]
    return markdown(head, body) + footnotes(body)


def success_row(
    results: MethodResults, actions: str = "deterministic", what: str | None = None
) -> dict[str, str]:
    """A row of :func:`success_table`, by column.

    Args:
        results: of a method.
        actions: `deterministic` (mean actions) or `sampled`.
        what: one of the task's evaluations; the first by default.
    """
    row = {"method": marked(results), "seeds": seeds_of(results)}
    which = {"actions": actions, "what": what}
    success = 100 * results.evaluated("success", **which)
    if success.empty:  # it diverged before its first checkpoint
        return row
    row["success [%]"] = estimate(success.to_numpy().mean(axis=1)).format(1)
    row["worst goal [%]"] = estimate(success.to_numpy().min(axis=1)).format(1)
    row["spread [%]"] = estimate(100 * results.variation("success", **which)).format(1)
    row["chance [%]"] = f"{100 * results.chance_variation(**which).mean():.1f}"
    for column, name in (("task_return", "task return"), ("return", "return")):
        if np.isfinite(results.evaluated(column, **which)).all(axis=None):
            row[name] = estimate(results.returns(column, **which)).format(2)
            row[f"spread of {name}"] = estimate(results.variation(column, **which)).format(2)
    row["symmetry loss"] = results.last_symmetry_loss
    if np.isfinite(results.evaluated("turning", **which)).any(axis=None):
        row["turning [rad]"] = estimate(results.returns("turning", **which)).format(2)
    return row


def efficiency_table(task: TaskResults) -> str:
    """Environment steps and seconds until a training has come so far."""
    head = ["method", "reached", "million steps, median", "seconds, median", "steps per second"]
    rows = []
    for results in task.values():
        steps, seconds = np.median(results.crossings, axis=0)
        known = [f"{steps:.2f}", f"{seconds:.0f}"] if np.isfinite(steps) else ["-", "-"]
        count = "{} of {}".format(*results.reached)
        rows.append([results.label, count, *known, f"{1 / results.seconds_per_step:,.0f}"])
    note = (
        f"Until the {task.measured}, averaged over {SMOOTHING} logged iterations, "
        f"reaches {task.threshold:.2f}: {SHARE:.0%} of\n"
        "the way from its first value to the best method's last. Seeds that never do count as infinite in\n"
        f"the median. A process of its own per run, threads: {task.study.about.get('threads', 1)}.\n"
    )
    return markdown(head, rows) + "\n" + note


def throughput_table(task: TaskResults) -> str:
    """Environment steps per second, learning included, and what the time goes into."""
    head = ["method", "steps per second", "physics", "inference, rewards, resets", "updates and the rest"]
    rows = []
    for results in task.values():
        parts = [_split(curve) for curve in results.curves.values()]
        every = np.concatenate([np.zeros((3, 0)), *parts], axis=1)
        if not every.shape[1]:
            rows.append([results.label, *["-"] * 4])
            continue
        shares = every.sum(axis=1) / every.sum()
        rate = 1 / results.seconds_per_step
        rows.append([results.label, f"{rate:,.0f}", *(f"{share:.0%}" for share in shares)])
    note = (
        "Of all seeds, each a process with one thread beside as many others as ran at a time; steps per\n"
        "second are the median over logged iterations, shares are of the sum.\n"
        "*updates and the rest*: all that is not the collection of data.\n"
    )
    return markdown(head, rows) + "\n" + note


def _split(curve: pd.DataFrame) -> np.ndarray:
    """Seconds of physics, the rest of the collection, and the rest, ``(3, intervals)``."""
    between = curve.diff().iloc[1:]
    iterations = between["iteration"].clip(lower=1)
    physics, collect = (curve[f"{name}_seconds"].iloc[1:] for name in ("physics", "collect"))
    split = np.stack([physics, collect - physics, between["seconds"] / iterations - collect])
    same = between["stage"].fillna(0).to_numpy() == 0
    return split[:, same & np.isfinite(split).all(axis=0)]


def seeds_of(results: MethodResults) -> str:
    """How many seeds a method has, and how many of them diverged."""
    seeds, gone = len(results.seeds), len(results.diverged)
    missing = seeds - len(results.evaluated())  # they diverged before a checkpoint
    return f"{seeds} ({gone} diverged, {missing} at once)" if gone else str(seeds)


def footnotes(rows: Sequence[Sequence[str]]) -> str:
    """What the marks in a table mean."""
    text = footnote("".join(cell for row in rows for cell in row))
    return f"\n{textwrap.fill(text, 100)}\n" if text else ""
