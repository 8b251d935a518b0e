"""The numbers of a comparison as Markdown: Table I of the paper, and how fast each method gets there."""

import textwrap

import numpy as np

from comparison.intervals import estimate, iqm
from comparison.methods import label
from comparison.reruns import footnote, marked
from comparison.study import Study, has_curriculum

SMOOTHING = 5  # logged iterations over which a training return is averaged
SHARE = 0.9  # of the way from the first return to the best method's last: the threshold of efficiency


def table_1(study: Study, task: str, methods: list[str] | None = None) -> str:
    """Return and variation between equivalent goals, per method (the paper's Table I)."""
    head = ["method", "seeds", "return", "variation", "largest variation", "symmetry loss"]
    rows = [head, ["---", *["---:"] * (len(head) - 1)]]
    for method in methods or study.methods(task):
        returns = study.goal_returns(task, method)[1]
        row = [marked(study, task, method), seeds_of(study, task, method)]
        if not len(returns):
            rows.append([*row, *["-"] * (len(head) - 2)])
            continue
        variations = variation(returns)
        comparable = returns.shape[1] > 1
        row += [estimate(returns.mean(axis=1)).format()]
        row += [estimate(variations).format(), f"{variations.max():.3f}"] if comparable else ["-", "-"]
        rows.append([*row, last_symmetry_loss(study, task, method)])
    note = (
        "*return*: mean over the equivalent goals, mean actions; *variation*: the largest difference\n"
        "between two goals; both as interquartile mean over seeds with its 95 % bootstrap interval.\n"
        "*largest variation*: that of the worst seed. *symmetry loss*: sum over the group of the squared\n"
        "distance of K_g[π(s)] from π(L_g[s]) on the states of the last iteration (interquartile mean of\n"
        "logarithms).\n"
    )
    return markdown(rows) + "\n" + note + footnotes(rows)


def footnotes(rows: list[list[str]]) -> str:
    """What the marks in a table mean."""
    text = footnote("".join(cell for row in rows for cell in row))
    return f"\n{textwrap.fill(text, 100)}\n" if text else ""


def seeds_of(study: Study, task: str, method: str) -> str:
    """How many seeds a method has, and how many of them diverged."""
    seeds, gone = len(study.seeds(task, method)), len(study.diverged(task, method))
    missing = seeds - len(study.goal_returns(task, method)[1])  # they diverged before a checkpoint
    return f"{seeds} ({gone} diverged, {missing} at once)" if gone else str(seeds)


def last_symmetry_loss(study: Study, task: str, method: str) -> str:
    """Interquartile mean of the logarithm at the end of training, as text."""
    curves = study.curve(task, method, "mirror_loss")[1]
    return f"{np.exp(iqm(np.log(np.maximum(curves[:, -1], 1e-12)))):.2g}" if len(curves) else "-"


def measured(study: Study, task: str) -> str:
    """What tells how far a training has come; see `Study.curve`."""
    curves = study.curves_of_task(task)
    return "level times success rate" if any(map(has_curriculum, curves)) else "training return"


def efficiency_table(study: Study, task: str) -> str:
    """Environment steps and seconds until a training has come so far."""
    goal = threshold(study, task)
    rows = [["method", "reached", "million steps, median", "seconds, median", "steps per second"]]
    rows.append(["---", *["---:"] * 4])
    for method in study.methods(task):
        steps, seconds = np.median(crossings(study, task, method, goal), axis=0)
        known = [f"{steps:.2f}", f"{seconds:.0f}"] if np.isfinite(steps) else ["-", "-"]
        count = "{} of {}".format(*reached(study, task, method))
        rows.append([label(method), count, *known, f"{1 / seconds_per_step(study, task, method):,.0f}"])
    note = (
        f"Until the {measured(study, task)}, averaged over {SMOOTHING} logged iterations, "
        f"reaches {goal:.2f}: {SHARE:.0%} of\n"
        "the way from its first value to the best method's last. Seeds that never do count as infinite in\n"
        f"the median. A process of its own per run, threads: {study.about.get('threads', 1)}.\n"
    )
    return markdown(rows) + "\n" + note


def variation(returns: np.ndarray) -> np.ndarray:
    """Largest difference between the mean returns of two goals, ``(seeds, goals)`` to ``(seeds,)``."""
    return returns.max(axis=1) - returns.min(axis=1)


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


def threshold(study: Study, task: str) -> float:
    """A progress that a good run makes, well above the first value."""
    first, last = [], []
    for method in study.methods(task):
        values = study.curve(task, method, "progress")[1]
        known = np.isfinite(values).all(axis=0)
        if len(values) and known.any():
            first.append(iqm(values[:, known][:, 0]))
            last.append(iqm(values[:, known][:, -1]))
    if not first:
        return float("nan")
    return float((1 - SHARE) * np.min(first) + SHARE * np.max(last))


def steps_to(study: Study, task: str, method: str, goal: float) -> np.ndarray:
    """Million steps at which each seed's smoothed progress first reaches a value; inf if never."""
    return crossings(study, task, method, goal)[:, 0]


def crossings(study: Study, task: str, method: str, goal: float) -> np.ndarray:
    """Million steps and seconds of training at which each seed gets to a progress, ``(seeds, 2)``."""
    curves = study.with_progress(task, method)
    found = [_crossing(curves.get(seed), goal) for seed in study.seeds(task, method)]
    return np.array(found).reshape(-1, 2)


def _crossing(curve: dict[str, np.ndarray] | None, goal: float) -> tuple[float, float]:
    if curve is not None and len(curve["frames"]) >= SMOOTHING:
        there = smooth(curve["progress"][None])[0] >= goal
        if there.any():
            at = there.argmax() + SMOOTHING - 1
            return curve["frames"][at] / 1e6, curve["seconds"][at]
    return np.inf, np.inf


def reached(study: Study, task: str, method: str) -> tuple[int, int]:
    """How many seeds reach the threshold, and how many there are."""
    found = np.isfinite(steps_to(study, task, method, threshold(study, task)))
    return int(found.sum()), len(found)


def steps_to_own(study: Study, task: str, method: str) -> np.ndarray:
    """Million steps to `SHARE` of the way to each seed's own last value: speed alone, wherever it ends."""
    steps, values = study.curve(task, method, "progress")
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
