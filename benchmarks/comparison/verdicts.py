"""Rules that turn a difference of two methods into a verdict.

Two methods are compared by the difference of interquartile means over seeds and its 95 % bootstrap
interval: *confirmed* if the interval lies on the claimed side of zero, *different* if it lies on the other
side, *not confirmed* if it contains zero. That something gains nothing is confirmed if the whole interval
is below a margin. Counts of seeds are compared by Fisher's exact test, at 2.5 % on either side like the
intervals. A verdict on fewer than five seeds says on how many.
"""

import math
from collections.abc import Callable, Mapping

import numpy as np
from scipy import stats

from comparison.intervals import Estimate, difference, iqm
from comparison.study import MethodResults

Figure = Callable[[MethodResults], np.ndarray]  # a number of every seed
# Verdicts on fewer seeds say so: where two methods do not differ, one in ten is confirmed by chance with
# three seeds, one in thirty with five.
FEW = 5


def pair(figure: Figure, a: MethodResults, b: MethodResults, digits: int = 3) -> tuple[str, Estimate]:
    """Both interquartile means, and the difference of the first minus the second, as text and number."""
    x, y = figure(a), figure(b)
    gap = difference(x, y)
    values = f"{a.label} {iqm(x):.{digits}f}, {b.label} {iqm(y):.{digits}f}"
    return f"{values}, difference {gap.format(digits)}", gap


def verdict(claimed_positive: Estimate) -> str:
    """The rule for a difference that the paper says is positive; undecided without an interval."""
    return _judged(claimed_positive, claimed_positive.low > 0, claimed_positive.high < 0)


def no_gain(gain: Estimate, margin: float) -> str:
    """The rule for a gain that the paper says is none; undecided without an interval."""
    return _judged(gain, gain.high < margin, gain.low > 0)


def _judged(found: Estimate, confirmed: bool, different: bool) -> str:
    if not math.isfinite(found.low):
        return "undecided"
    return _of_seeds(confirmed, different, found.seeds)


def more(a: tuple[int, int], b: tuple[int, int]) -> str:
    """The rule for counts, of a total each, of which the paper says the first is larger."""
    table = [[a[0], a[1] - a[0]], [b[0], b[1] - b[0]]]
    larger, smaller = (stats.fisher_exact(table, alternative=side).pvalue for side in ("greater", "less"))
    return _of_seeds(larger < 0.025, smaller < 0.025, min(a[1], b[1]))


def _of_seeds(confirmed: bool, different: bool, seeds: int) -> str:
    outcome = "confirmed" if confirmed else "different" if different else "not confirmed"
    return outcome if seeds >= FEW else f"{outcome} ({seeds} seeds)"


def joined(verdicts: Mapping[str, str]) -> str:
    """One verdict if all agree, or else each with its name."""
    if len(set(verdicts.values())) == 1:
        return next(iter(verdicts.values()))
    return ", ".join(f"{name}: {outcome}" for name, outcome in verdicts.items())
