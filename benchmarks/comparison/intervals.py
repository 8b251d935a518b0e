"""Statistics of few seeds: interquartile means and bootstrap intervals, after Agarwal et al. 2021.

The interquartile mean drops the lowest and the highest quarter: one seed that failed does not drown the
others, as it would in a mean, and unlike a median it uses half of the data. Its interval, and that of a
difference, is bootstrapped over seeds (95 %, percentiles), with a fixed generator, so that results are
drawn alike every time. (Deep Reinforcement Learning at the Edge of the Statistical Precipice, NeurIPS.)
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

RESAMPLES = 20_000  # an end of an interval that a verdict hangs on moves by a fiftieth of its width
BAND_RESAMPLES = 2000  # at every point of a curve


@dataclass(frozen=True)
class Estimate:
    """A number, its 95 % interval, and how many seeds it is of (the fewer, of a difference)."""

    value: float
    low: float
    high: float
    seeds: int = 1

    def format(self, digits: int = 3) -> str:
        """For a table; without interval if there is none."""
        if not math.isfinite(self.low):
            return f"{self.value:.{digits}f}"
        return f"{self.value:.{digits}f} ({self.low:.{digits}f} to {self.high:.{digits}f})"


def iqm(values: np.ndarray, axis: int = 0) -> np.ndarray:
    """Interquartile mean along an axis."""
    return stats.trim_mean(values, 0.25, axis=axis)


def estimate(values: np.ndarray) -> Estimate:
    """Interquartile mean over seeds ``(seeds,)`` with its interval; no interval for a single seed."""
    value = float(iqm(values))
    if len(values) < 2:
        return Estimate(value, -math.inf, math.inf)
    low, high = band(np.asarray(values, dtype=float)[:, None], RESAMPLES)
    return Estimate(value, float(low[0]), float(high[0]), len(values))


def band(values: np.ndarray, resamples: int = BAND_RESAMPLES) -> tuple[np.ndarray, np.ndarray]:
    """Interval of the interquartile mean over seeds at every point, ``(seeds, points)``."""
    if len(values) < 2:
        return values[0], values[0]
    result = stats.bootstrap(
        (values,), iqm, axis=0, n_resamples=resamples, method="percentile", vectorized=True, rng=0
    )
    return result.confidence_interval.low, result.confidence_interval.high


def difference(a: np.ndarray, b: np.ndarray) -> Estimate:
    """Interquartile mean of ``a`` minus that of ``b``, ``(seeds,)`` each, resampled independently."""
    value = float(iqm(a) - iqm(b))
    fewest = min(len(a), len(b))
    if fewest < 2:
        return Estimate(value, -math.inf, math.inf)
    result = stats.bootstrap(
        (np.asarray(a, dtype=float), np.asarray(b, dtype=float)),
        lambda x, y, axis=-1: iqm(x, axis) - iqm(y, axis),
        n_resamples=RESAMPLES,
        method="percentile",
        vectorized=True,
        rng=0,
    )
    interval = result.confidence_interval
    return Estimate(value, float(interval.low), float(interval.high), fewest)
