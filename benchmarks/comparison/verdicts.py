"""Rules that turn a difference of two methods into a verdict, and the figures that they are given.

Two methods are compared by the difference of interquartile means over seeds and its 95 % bootstrap
interval: *confirmed* if the interval lies on the claimed side of zero, *different* if it lies on the other
side, *not confirmed* if it contains zero. That something gains nothing is confirmed if the whole interval
is below a margin. Counts of seeds are compared by Fisher's exact test, at 2.5 % on either side like the
intervals. A verdict on fewer than five seeds says on how many.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from comparison.intervals import Estimate, difference, iqm
from comparison.methods import label
from comparison.study import LAST_PHASE, Study
from comparison.tables import SHARE, SMOOTHING, reached, smooth, steps_to, threshold, variation

Judgement = tuple[str, str]  # evidence, verdict
# Verdicts on fewer seeds say so: where two methods do not differ, one in ten is confirmed by chance with
# three seeds, one in thirty with five.
FEW = 5


@dataclass(frozen=True)
class Claim:
    """What the paper says, where, how it is judged here, and what has to be there for it."""

    text: str
    place: str
    judge: Callable[[Any], Any]  # Judgement, or None where there is nothing to judge
    methods: tuple[str, ...] = ()
    figure: str | None = "return"  # what an evaluation must have; None where training alone is judged

    def row(self, judgement: Judgement) -> list[str]:
        """Its row in a table."""
        return [self.text, self.place, judgement[0], f"**{judgement[1]}**"]


class Claims(list[Claim]):
    """Claims in the order of their judges; called with a claim, it decorates the judge."""

    HEAD = (["claim", "place", "evidence here", "verdict"], ["---"] * 4)

    def __call__(self, text: str, place: str, *methods: str, figure: str | None = "return"):
        """Register a judge where it is defined."""

        def register(judge: Callable[[Any], Any]):
            self.append(Claim(text, place, judge, methods, figure))
            return judge

        return register


def returns(study: Study, method: str, *, task: str, **which: str | None) -> np.ndarray:
    """Evaluated return of every seed, or what else `Study.goal_returns` is asked for."""
    return study.goal_returns(task, method, **which)[1].mean(axis=1)


def variations(study: Study, method: str, *, task: str, **which: str | None) -> np.ndarray:
    """Difference between the goals, of every seed."""
    return variation(study.goal_returns(task, method, **which)[1])


def symmetry_loss(study: Study, method: str, *, task: str) -> np.ndarray:
    """Decimal logarithm of the last symmetry loss of every seed."""
    return np.log10(np.maximum(study.curve(task, method, "mirror_loss")[1][:, -1], 1e-12))


def steps(study: Study, method: str, *, task: str) -> np.ndarray:
    """Million steps to the threshold; seeds that never reach it count as the whole curve."""
    found = steps_to(study, task, method, threshold(study, task))
    return np.minimum(found, study.curve(task, method, "progress")[0][-1])


def recovery(study: Study, method: str, *, task: str) -> np.ndarray:
    """Million steps from the start of a curriculum's last phase to nine tenths of what is regained in it.

    That is, of the way from the lowest training return of the phase to the last one in the curriculum; NaN
    for a seed that never enters the phase.
    """
    taken = []
    for curve in study.with_progress(task, method).values():
        there = np.flatnonzero((curve["phase"] == LAST_PHASE) & np.isfinite(curve["return"]))
        steps_, level = curve["frames"][there] / 1e6, curve["return"][there]
        if len(there) < SMOOTHING:
            taken.append(np.nan)
            continue
        level = smooth(level[None])[0]
        lowest = int(level.argmin())
        goal = (1 - SHARE) * level[lowest] + SHARE * level[-1]
        regained = lowest + int((level[lowest:] >= goal).argmax())
        taken.append(steps_[regained + SMOOTHING - 1] - steps_[0])
    return np.array(taken)


def counted(study: Study, method: str, *, task: str) -> str:
    """How many seeds of a method reach the threshold, as text."""
    return "{} {} of {}".format(label(method), *reached(study, task, method))


def verdict(claimed_positive: Estimate) -> str:
    """The rule for a difference that the paper says is positive; undecided without an interval."""
    if not math.isfinite(claimed_positive.low):
        return "undecided"
    if claimed_positive.low > 0:
        return _of_seeds("confirmed", claimed_positive.seeds)
    return _of_seeds("different" if claimed_positive.high < 0 else "not confirmed", claimed_positive.seeds)


def no_gain(gain: Estimate, margin: float) -> str:
    """The rule for a gain that the paper says is none; undecided without an interval."""
    if not math.isfinite(gain.low):
        return "undecided"
    if gain.high < margin:
        return _of_seeds("confirmed", gain.seeds)
    return _of_seeds("different" if gain.low > 0 else "not confirmed", gain.seeds)


def _of_seeds(outcome: str, seeds: int) -> str:
    return outcome if seeds >= FEW else f"{outcome} ({seeds} seeds)"


def more(a: tuple[int, int], b: tuple[int, int]) -> str:
    """The rule for counts, of a total each, of which the paper says the first is larger."""
    table = [[a[0], a[1] - a[0]], [b[0], b[1] - b[0]]]
    larger, smaller = (stats.fisher_exact(table, alternative=side).pvalue for side in ("greater", "less"))
    outcome = "confirmed" if larger < 0.025 else "different" if smaller < 0.025 else "not confirmed"
    return _of_seeds(outcome, min(a[1], b[1]))


def pair(study: Study, what: Callable, a: str, b: str, digits: int = 3) -> tuple[str, Estimate]:
    """Both interquartile means, and the difference of the first minus the second, as text and number."""
    x, y = what(study, a), what(study, b)
    gap = difference(x, y)
    values = f"{label(a)} {iqm(x):.{digits}f}, {label(b)} {iqm(y):.{digits}f}"
    return f"{values}, difference {gap.format(digits)}", gap


def joined(**verdicts: str) -> str:
    """One verdict if all agree, or else each with its name."""
    if len(set(verdicts.values())) == 1:
        return next(iter(verdicts.values()))
    return ", ".join(f"{name.replace('_', ' ')}: {outcome}" for name, outcome in verdicts.items())
