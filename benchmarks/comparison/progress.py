"""How far a training has come, and when: from the curve of one seed.

What is measured is the training return. Where there is a curriculum, in which returns fall as tasks get
harder, it is the level times the success rate: zero before the last phase and the last task of the
curriculum, and not continued once training leaves it for the last level alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

LAST_PHASE = 2.0  # of a curriculum in three phases
SMOOTHING = 5  # logged iterations over which a training return is averaged
SHARE = 0.9  # of the way from the first value to the last: what counts as having come there


def has_curriculum(curve: pd.DataFrame) -> bool:
    """Whether a run has levels and successes."""
    return bool(np.isfinite(curve[["level", "success"]]).any().all())


def with_progress(curve: pd.DataFrame, stages: list[dict[str, Any]]) -> pd.DataFrame:
    """A run's curve, as long as there is a curriculum, with a column `progress`.

    Args:
        curve: rows of the run.
        stages: what each stage trained with, of `study.json`; empty for one task throughout.
    """
    if not has_curriculum(curve):
        return curve.assign(progress=curve["return"])
    counts = curve["phase"].fillna(LAST_PHASE) == LAST_PHASE
    tasks = [stage["task"] for stage in stages]
    rising = [number for number, task in enumerate(tasks) if task.get("curriculum", True)]
    last = [number for number in rising if tasks[number] == tasks[rising[-1]]]
    curve = curve.assign(progress=curve["level"] * curve["success"] * counts)
    if not last:
        return curve
    curve["progress"] *= curve["stage"].isin(last)
    return curve[curve["stage"] <= last[-1]]


def smooth(values: np.ndarray) -> np.ndarray:
    """Mean of the last few logged iterations, along the last axis; as many points fewer, less one."""
    return np.lib.stride_tricks.sliding_window_view(values, SMOOTHING, axis=-1).mean(axis=-1)


def crossing(curve: pd.DataFrame | None, goal: float) -> tuple[float, float]:
    """Million steps and seconds at which a smoothed progress first reaches a value; inf if never."""
    if curve is not None and len(curve) >= SMOOTHING:
        there = smooth(curve["progress"].to_numpy()) >= goal
        if there.any():
            at = curve.iloc[there.argmax() + SMOOTHING - 1]
            return at["frames"] / 1e6, at["seconds"]
    return np.inf, np.inf


def recovery(curve: pd.DataFrame) -> float:
    """Million steps from the start of a curriculum's last phase to nine tenths of what is regained in it.

    That is, of the way from the lowest training return of the phase to the last one in the curriculum; NaN
    for a seed that never enters the phase.
    """
    phase = curve[(curve["phase"] == LAST_PHASE) & np.isfinite(curve["return"])]
    if len(phase) < SMOOTHING:
        return np.nan
    level, steps = smooth(phase["return"].to_numpy()), phase["frames"].to_numpy() / 1e6
    lowest = int(level.argmin())
    goal = (1 - SHARE) * level[lowest] + SHARE * level[-1]
    regained = lowest + int((level[lowest:] >= goal).argmax())
    return steps[regained + SMOOTHING - 1] - steps[0]
