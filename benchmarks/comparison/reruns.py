"""Which rows of stored results were trained by a rule that has changed since: they await a rerun.

Results are kept until they are made again, and say what they are. A rule is one of three: how the learning
rate is adapted, how noisy the policy is in the last stage, which numbers a method is trained with. It is
judged for every method by the settings and curves that are stored, so that a mark goes by itself with the
rerun.
"""

from typing import Any

import numpy as np

from comparison.environments import task_setting
from comparison.run import described
from comparison.study import MethodResults
from tasks.settings import SETTINGS

RULES = {
    "†": "the learning rate was adapted one minibatch late",
    "‡": "the deviation of the last stage was learned below a cap, or frozen at it, and not that of the "
    "schedule which all methods have now",
    "§": "the settings have been tuned anew since",
}
"""Marks, and what has changed."""

OURS = {*SETTINGS, "repose_yaw:make_env"}
"""Tasks whose settings are looked up; no other module that results name is imported."""

_NOISE = {"std_schedule", "initial_std", "min_std", "max_std"}
_RUN = {"seed", "checkpoint_interval", "device"}


def marks(results: MethodResults) -> str:
    """The marks of a method; empty if it would be trained alike today."""
    task, stored = results.task.name, results.stages
    if task not in OURS or not stored:
        return ""
    today = described(results.method.configure(task_setting(task), 0))
    before = [stage["config"] for stage in stored if "std_schedule" not in stage["config"]]
    late = any(c["adapt_every"] == "minibatch" and c["desired_kl"] is not None for c in before)
    other = len(stored) != len(today) or any(map(_differ, stored, today))
    noisy = bool(before) and not _as_scheduled(results, today[-1]["config"]["std_schedule"])
    return "".join(mark for mark, true in zip(RULES, (late, noisy, other), strict=True) if true)


def marked(results: MethodResults) -> str:
    """How tables call a method, with its marks."""
    return f"{results.label} {marks(results)}".rstrip()


def footnote(found: str) -> str:
    """What the marks in a text mean, as a sentence; empty if there is none."""
    used = [f"{mark} {meaning}" for mark, meaning in RULES.items() if mark in found]
    return f"Rows that await a rerun: {'; '.join(used)}." if used else ""


def _differ(stored: dict[str, Any], today: dict[str, Any]) -> bool:
    config = today["config"]
    names = config.keys() & stored["config"].keys() - _NOISE - _RUN
    return stored["task"] != today["task"] or any(stored["config"][n] != config[n] for n in names)


def _as_scheduled(results: MethodResults, schedule: list[float] | None) -> bool:
    """Whether all seeds had the deviation of a schedule in their last stage."""
    if schedule is None:
        return True
    for curve in results.curves.values():
        last = curve["std"][curve["stage"] == curve["stage"].max()]
        if schedule[0] != schedule[1] or not np.allclose(last, schedule[0], rtol=1e-3):
            return False
    return True
