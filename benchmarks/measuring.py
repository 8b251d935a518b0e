"""Variants timed in turn, round by round, so that a machine that slows down slows all of them."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median


def interleave(
    variants: dict[str, Callable[[], object]], rounds: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, list[float]]:
    """Seconds of each variant, round by round, after two rounds of warm-up."""
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    for round_ in range(rounds + 2):
        for name, run in variants.items():
            start = clock()
            run()
            if round_ >= 2:
                seconds[name].append(clock() - start)
    return seconds


def ratio(seconds: dict[str, list[float]], a: str, b: str) -> float | None:
    """Median over the rounds of time a over time b; None where b was not measured."""
    if b not in seconds:
        return None
    return median(x / y for x, y in zip(seconds[a], seconds[b], strict=True))


def show(table: list[dict]) -> None:
    """Print the last row of a table, under its header if it is the first."""
    widths = {key: max(len(key), 9) for key in table[-1]}
    if len(table) == 1:
        print("  ".join(f"{key:>{width}s}" for key, width in widths.items()))
    print("  ".join(f"{cell(table[-1][key]):>{width}s}" for key, width in widths.items()))


def cell(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"
    return str(value)
