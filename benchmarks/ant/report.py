"""What the off-policy study found: picture and page with verdicts, from the stored curves alone."""

from __future__ import annotations

import csv
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from comparison.intervals import Estimate, band, estimate, iqm
from plot import grid, legend

ARMS = {"plain": "tab:orange", "symmetric": "tab:blue"}
NAMES = {"sac": "SAC", "td3": "TD3"}
PANELS = {
    "return": "return",
    "mirror_error": "mirror error",
    "drift": "drift to one side (m)",
}
Curve = dict[str, np.ndarray]  # column: (evaluations,)
Curves = dict[tuple[str, str], dict[int, Curve]]  # (algorithm, arm): seed: its curve


def read(path: Path) -> Curves:
    """The stored table, by algorithm and arm, and by seed."""
    rows: dict[tuple[str, str], dict[int, list[dict[str, float]]]] = {}
    with path.open() as file:
        for row in csv.DictReader(file):
            key = row.pop("algorithm"), row.pop("arm")
            values = {name: float(value) for name, value in row.items()}
            values["drift"] = abs(values["y"])
            rows.setdefault(key, {}).setdefault(int(values["seed"]), []).append(values)
    return {
        key: {
            seed: {name: np.array([row[name] for row in own]) for name in own[0]}
            for seed, own in sorted(seeds.items())
        }
        for key, seeds in rows.items()
    }


def area(values: np.ndarray) -> float:
    """Area under a curve of evenly spaced evaluations, over its length."""
    return float(values.mean())


def late(values: np.ndarray) -> float:
    """Mean over the last quarter of the evaluations."""
    return float(values[-max(1, len(values) // 4) :].mean())


# measure: column, figure of a curve, verdict if symmetric is higher, verdict if it is lower
MEASURES: dict[str, tuple[str, Callable[[np.ndarray], float], str, str]] = {
    "area under the curve of returns": ("return", area, "helps", "hurts"),
    "late mirror error": ("mirror_error", late, "less symmetric", "more symmetric"),
    "late drift (m)": ("drift", late, "less straight", "straighter"),
    "late return": ("return", late, "", ""),
}


def figures(curves: dict[int, Curve], column: str, figure: Callable[[np.ndarray], float]) -> np.ndarray:
    """One number per seed, in the order of the seeds."""
    return np.array([figure(curve[column]) for curve in curves.values()])


def verdict(difference: Estimate, higher: str, lower: str) -> str:
    """What an interval of a paired difference says."""
    if not higher:
        return ""
    return higher if difference.low > 0 else lower if difference.high < 0 else "undecided"


def picture(curves: Curves, path: Path) -> None:
    """Curves of both arms: interquartile means over seeds and their 95 % intervals."""
    algorithms = [name for name in NAMES if any(key[0] == name for key in curves)]
    figure, axes = grid(len(PANELS), len(algorithms), 5.2, 2.6)
    for column, algorithm in enumerate(algorithms):
        for axis, (name, what) in zip(axes[:, column], PANELS.items(), strict=True):
            for arm, color in ARMS.items():
                own = curves.get((algorithm, arm))
                if not own:
                    continue
                steps = next(iter(own.values()))["frames"] / 1000
                values = np.array([curve[name] for curve in own.values()])
                label = f"{arm} replay, {len(own)} seeds"
                axis.plot(steps, iqm(values), color=color, linewidth=1.4, label=label)
                axis.fill_between(steps, *band(values), color=color, alpha=0.15, linewidth=0)
                for single in values:
                    axis.plot(steps, single, color=color, linewidth=0.4, alpha=0.5)
            axis.set(ylabel=what)
            axis.locator_params(axis="x", integer=True)
        axes[0, column].set_title(f"{NAMES[algorithm]} on Ant-v5")
        axes[-1, column].set_xlabel("thousand environment steps of a seed")
        legend(axes[0, column])
    for row in axes:
        limits = [axis.get_ylim() for axis in row]
        for axis in row:
            axis.set_ylim(min(low for low, _ in limits), max(high for _, high in limits))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


@dataclass(frozen=True)
class Row:
    """One measure of both arms."""

    name: str
    plain: Estimate
    symmetric: Estimate
    difference: Estimate
    verdict: str

    def format(self) -> str:
        digits = 2 if max(abs(self.plain.value), abs(self.symmetric.value)) < 10 else 1
        cells = [x.format(digits) for x in (self.plain, self.symmetric, self.difference)]
        return f"| {self.name} | {' | '.join(cells)} | {self.verdict} |"


def measured(curves: Curves, algorithm: str) -> list[Row]:
    """Both arms, their paired difference and the verdict, by measure."""
    arms = [curves[algorithm, arm] for arm in ARMS]
    if len({tuple(own) for own in arms}) > 1:
        raise ValueError(
            f"{algorithm}: expected both arms to have the same seeds, got {[list(own) for own in arms]}; "
            "train the ones that are missing"
        )
    rows = []
    for name, (column, figure, higher, lower) in MEASURES.items():
        plain, symmetric = (figures(own, column, figure) for own in arms)
        difference = estimate(symmetric - plain)
        word = verdict(difference, higher, lower)
        rows.append(Row(name, estimate(plain), estimate(symmetric), difference, word))
    return rows


def table(rows: list[Row]) -> str:
    head = (
        "| measure | plain | symmetric | symmetric minus plain, in pairs | verdict |\n|---|---|---|---|---|"
    )
    return "\n".join([head, *(row.format() for row in rows)])


INTRODUCTION = """\
# Symmetric replay off policy: SAC and TD3 on Ant-v5

Made by `{command}` from [benchmarks/results/off-policy](../benchmarks/results/off-policy); a test compares.
{packages}; {machine}; {hours:.1f} hours of one core in training.

What came out: {found}.

The Ant is rewarded for speed along x, so its mirror image in the plane y = 0 earns what it earns itself
(`torchrl_sym.mujoco.verify` says so). *Symmetric* replay maps every sampled row,
state, action and next state together, by one random element of {{e, reflect-y}}; *plain* replay does not.
All else is equal: {frames:,} frames of a seed from {envs} environments, {steps:,} gradient steps of
{rows} rows, networks of two hidden layers of {cells}, and, seed by seed, initial networks and starts.
Seeds: {seeds}. The task is Ant-v5 at half power, without a reward for standing and without an end when it
falls, so that a policy walks within ten thousand gradient steps (`benchmarks/ant/world.py`). That is a
small budget, on purpose: the study says what symmetric replay does early in training, not where training
ends.

Numbers are interquartile means over seeds with 95 % bootstrap intervals; *late* is the mean over the last
quarter of the evaluations. The rules, written before the first of these runs: the area under the curve of
returns decides whether symmetric replay *helps* or *hurts*, which it does if the interval of the paired
difference excludes zero; mirror error (mean square over action entries of pi(L_g s) - K_g pi(s)) and
drift (how far the episodes of an evaluation end on average to one side) say, by the same rule, whether
the policy became *more symmetric* and walks *straighter*; the late return has no verdict. Settings were
chosen with other seeds, the first of them on either arm, the last ones on the plain arm. Five seeds are
few: what is undecided here may be decided by more.

![Curves](../benchmarks/plots/off-policy/curves.png)

Interquartile means over seeds, 95 % intervals, and every seed as a thin line. Evaluations are of the
deterministic policy, {episodes} episodes each."""


def page(curves: Curves, study: dict) -> str:
    """The page of the study, all of it from the stored results."""
    runs = [next(iter(own.values())) for own in curves.values()]  # seeds of a run share its time
    facts = {
        "command": study["command"],
        "machine": study["machine"],
        "packages": ", ".join(f"{name} {number}" for name, number in study["packages"].items()),
        "hours": sum(curve["seconds"][-1] for curve in runs) / 3600,
        "seeds": ", ".join(map(str, next(iter(curves.values())))),
        "steps": int(runs[0]["updates"][-1]),
    }
    setting = {name: value for name, value in study["setting"].items() if name not in facts}
    rows = {name: measured(curves, name) for name in NAMES if all((name, arm) in curves for arm in ARMS)}
    found = "; ".join(
        f"{NAMES[name]}, " + ", ".join(f"{row.name}: *{row.verdict}*" for row in own if row.verdict)
        for name, own in rows.items()
    )
    text = INTRODUCTION.format(found=found, **facts, **setting)
    parts = [textwrap.fill(part, 106, break_on_hyphens=False) for part in text.split("\n\n")]
    parts += [f"## {NAMES[name]}\n\n{table(own)}" for name, own in rows.items()]
    return "\n\n".join(parts) + "\n"
