"""The numbers of a comparison as Markdown: Table I of the paper, and how fast each method gets there."""

from collections.abc import Sequence

import numpy as np

from comparison.intervals import estimate, iqm
from comparison.methods import label
from comparison.study import Study

SMOOTHING = 5  # logged iterations over which a training return is averaged
SHARE = 0.9  # of the way from the first return to the best method's last: the threshold of efficiency


def tables(study: Study) -> str:
    """All tables of a study."""
    text = f"Made by `{study.about['command']}` at {', '.join(study.about['revisions'])}, "
    text += f"{study.about['machine']}, {study.about['workers']} runs at a time.\n"
    for task in study.tasks:
        body = success_tables(study, task) if has_success(study, task) else table_1(study, task)
        text += f"\n## {task}\n\n{body}\n{efficiency_table(study, task)}"
        if has_split(study, task):
            text += f"\n{throughput_table(study, task)}"
    return text


def table_1(study: Study, task: str, methods: list[str] | None = None) -> str:
    """Return and variation between equivalent goals, per method (the paper's Table I)."""
    head = ["method", "seeds", "return", "variation", "largest variation", "symmetry loss"]
    rows = [head, ["---", *["---:"] * (len(head) - 1)]]
    for method in methods or study.methods(task):
        returns = study.goal_returns(task, method)[1]
        row = [label(method), seeds_of(study, task, method)]
        if not len(returns):
            rows.append([*row, *["-"] * (len(head) - 2)])
            continue
        variations = variation(returns)
        comparable = returns.shape[1] > 1
        row += [estimate(returns.mean(axis=1)).format()]
        row += [estimate(variations).format(), f"{variations.max():.3f}"] if comparable else ["-", "-"]
        rows.append([*row, symmetry_loss(study, task, method)])
    note = (
        "*return*: mean over the equivalent goals, mean actions; *variation*: the largest difference\n"
        "between two goals; both as interquartile mean over seeds with its 95 % bootstrap interval.\n"
        "*largest variation*: that of the worst seed. *symmetry loss*: sum over the group of the squared\n"
        "distance of K_g[π(s)] from π(L_g[s]) on the states of the last iteration (interquartile mean of\n"
        "logarithms).\n"
    )
    return markdown(rows) + "\n" + note


def success_tables(study: Study, task: str, methods: list[str] | None = None) -> str:
    """Table I for tasks that succeed or fail: a table per evaluation and kind of actions."""
    kinds = {"sampled": "sampled actions, as in training", "deterministic": "mean actions"}
    text = ""
    for what in study.evaluations(task):
        for actions, name in kinds.items():
            title = name if what == "task" else f"{what}, {name}"
            text += f"{title[0].upper()}{title[1:]}:\n\n"
            text += success_table(study, task, methods, actions, what) + "\n"
    return text + (
        "Interquartile means over seeds, in brackets their 95 % bootstrap intervals. *worst goal*: the\n"
        "lowest success of a goal (mean over seeds). *spread*: the largest difference between two goals\n"
        "of a seed, in success (percentage points) or return. *task return*: without terms of gait and\n"
        "effort. *turning*: yaw travelled in an episode. *symmetry loss*: as in the paper, on the states\n"
        "of the last iteration.\n"
    )


def success_table(
    study: Study,
    task: str,
    methods: list[str] | None = None,
    actions: str = "sampled",
    what: str = "task",
    columns: Sequence[int] | None = None,
) -> str:
    """Success, task return and return of every method, each with its spread over the goals.

    Args:
        study: the results.
        task: one of its tasks.
        methods: rows; all by default.
        actions: `sampled` or `deterministic`.
        what: one of the task's evaluations.
        columns: numbers of the columns to show; all by default.
    """
    head = ["method", "seeds", "success [%]", "worst goal", "spread", "task return", "spread", "return"]
    head += ["spread", "symmetry loss"]
    shown = methods or study.methods(task)
    turns = {m: study.goal_returns(task, m, "turning", actions, what)[1] for m in shown}
    turned = any(np.isfinite(values).any() for values in turns.values())
    head += ["turning [rad]"] * turned
    rows = [head, ["---", *["---:"] * (len(head) - 1)]]
    for method in shown:
        row = [label(method), seeds_of(study, task, method)]
        success = 100 * study.goal_returns(task, method, "success", actions, what)[1]
        if not len(success):
            rows.append([*row, *["-"] * (len(head) - 2)])
            continue
        row += [estimate(success.mean(axis=1)).format(1), f"{success.mean(axis=0).min():.1f}"]
        row += [estimate(variation(success)).format(1)]
        for column in ("task_return", "return"):
            values = study.goal_returns(task, method, column, actions, what)[1]
            row += [estimate(values.mean(axis=1)).format(2), estimate(variation(values)).format(2)]
        row += [symmetry_loss(study, task, method)]
        row += [estimate(turns[method].mean(axis=1)).format(2)] * turned
        rows.append(row)
    return markdown(rows if columns is None else [[row[i] for i in columns] for row in rows])


def seeds_of(study: Study, task: str, method: str) -> str:
    """How many seeds a method has, and how many of them diverged."""
    seeds, gone = len(study.seeds(task, method)), len(study.diverged(task, method))
    missing = seeds - len(study.goal_returns(task, method)[1])  # they diverged before a checkpoint
    return f"{seeds} ({gone} diverged, {missing} at once)" if gone else str(seeds)


def symmetry_loss(study: Study, task: str, method: str) -> str:
    """Interquartile mean of the logarithm, at the end of training."""
    loss = np.maximum(study.curve(task, method, "mirror_loss")[1][:, -1], 1e-12)
    return f"{np.exp(iqm(np.log(loss))):.2g}"


def has_success(study: Study, task: str) -> bool:
    """Whether episodes of a task succeed or fail."""
    return any(row["task"] == task and row.get("success") is not None for row in study.runs)


def has_split(study: Study, task: str) -> bool:
    """Whether it was logged what the time of a task's training went into."""
    return any("physics_seconds" in c for c in study.curves_of_task(task))


def throughput_table(study: Study, task: str) -> str:
    """Environment steps per second, learning included, and what the time goes into."""
    rows = [["method", "steps per second, one core", "physics", "inference, rewards, resets", "update"]]
    rows.append(["---", *["---:"] * 4])
    for method in study.methods(task):
        parts = []
        for c in study.curves_of(task, method).values():
            iterations = np.diff(c["iteration"])
            whole = np.diff(c["seconds"])
            same = iterations > 0  # not across two stages
            each = whole[same] / iterations[same]
            collect, physics = c["collect_seconds"][1:][same], c["physics_seconds"][1:][same]
            parts.append(np.stack([physics, collect - physics, each - collect]) / each)
        shares = np.median(np.concatenate(parts, axis=1), axis=1)
        rate = 1 / seconds_per_step(study, task, method)
        rows.append([label(method), f"{rate:,.0f}", *(f"{share:.0%}" for share in shares)])
    note = (
        "Medians of one process with one thread, measured while every other core was busy with another run:\n"
        "two cores make twice as many steps in all.\n"
    )
    return markdown(rows) + "\n" + note


def efficiency_table(study: Study, task: str) -> str:
    """Environment steps and seconds until the training return reaches a threshold."""
    goal = threshold(study, task)
    rows = [["method", "reached", "million steps, median", "seconds, median", "steps per second"]]
    rows.append(["---", *["---:"] * 4])
    for method in study.methods(task):
        reached = steps_to(study, task, method, goal)
        cost = seconds_per_step(study, task, method)
        middle = np.median(reached) if len(reached) else np.inf
        known = [f"{middle:.2f}", f"{middle * 1e6 * cost:.0f}"] if np.isfinite(middle) else ["-", "-"]
        count = f"{np.isfinite(reached).sum()} of {len(reached)}"
        rows.append([label(method), count, *known, f"{1 / cost:,.0f}"])
    note = (
        f"Until the training return, averaged over {SMOOTHING} logged iterations, reaches {goal:.2f}: "
        f"{SHARE:.0%} of\nthe way from its first value to the best method's last. Seeds that never do "
        "count as infinite in\nthe median. One process with one thread per run.\n"
    )
    return markdown(rows) + "\n" + note


def variation(returns: np.ndarray) -> np.ndarray:
    """Largest difference between the mean returns of two goals, ``(seeds, goals)`` to ``(seeds,)``."""
    return returns.max(axis=1) - returns.min(axis=1)


def threshold(study: Study, task: str) -> float:
    """A return that a good run reaches, well above the first one."""
    first, last = [], []
    for method in study.methods(task):
        values = study.curve(task, method, "return")[1]
        known = np.isfinite(values).all(axis=0)
        if len(values) and known.any():
            first.append(iqm(values[:, known][:, 0]))
            last.append(iqm(values[:, known][:, -1]))
    if not first:
        return float("nan")
    return float((1 - SHARE) * np.min(first) + SHARE * np.max(last))


def steps_to(study: Study, task: str, method: str, goal: float) -> np.ndarray:
    """Million steps at which each seed's smoothed training return first reaches a value; inf if never."""
    steps, values = study.curve(task, method, "return")
    never = np.full(len(study.seeds(task, method)), np.inf)
    if len(steps) < SMOOTHING:
        return never
    there = smooth(values) >= goal
    reached = np.where(there.any(axis=1), steps[SMOOTHING - 1 :][there.argmax(axis=1)], np.inf)
    return np.concatenate([reached, never[len(reached) :]])


def steps_to_own(study: Study, task: str, method: str) -> np.ndarray:
    """Million steps to `SHARE` of the way to each seed's own last return: speed alone, wherever it ends."""
    steps, values = study.curve(task, method, "return")
    levels = smooth(values)
    first = np.array([row[np.isfinite(row)][0] for row in levels])
    there = levels >= ((1 - SHARE) * first + SHARE * levels[:, -1])[:, None]
    return steps[SMOOTHING - 1 :][there.argmax(axis=1)]


def smooth(values: np.ndarray) -> np.ndarray:
    """Mean of the last few logged iterations; as many points fewer, less one."""
    return np.lib.stride_tricks.sliding_window_view(values, SMOOTHING, axis=1).mean(axis=-1)


def seconds_per_step(study: Study, task: str, method: str) -> float:
    """Wall-clock seconds per environment step: the median over all logged intervals of all seeds."""
    costs = [
        np.diff(c["seconds"]) / np.diff(c["frames"])
        for c in study.curves_of(task, method).values()
        if len(c["frames"]) > 1
    ]
    return float(np.median(np.concatenate(costs))) if costs else float("nan")


def markdown(rows: list[list[str]]) -> str:
    """A table; the second row aligns the columns."""
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)
