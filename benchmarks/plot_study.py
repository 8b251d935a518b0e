"""Figures of the study of networks and asymmetry (docs/study.md), from stored results alone.

python benchmarks/study_page.py   # draws them, and writes the page around them
"""

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from comparison.doses import Dose, Doses
from comparison.intervals import estimate
from comparison.study import TaskResults
from plot import color, grid, legend, share_limits, style_of

WAYS = {True: "trained and evaluated under it", False: "trained without, evaluated under it"}
UNITS = {"motor_bias": "motor bias [m/s]", "rail_tilt": "tilt of the rail [°]", "wind": "wind [m/s]"}
LEAST_VARIATION = 1e-7  # what rounding leaves of an exact policy's is drawn there


def doses(on: Doses) -> Figure:
    """Return over the dose, a column per knob; above trained under it, below trained without."""
    figure, axes = grid(2, len(on.knobs), 4.4, 3.3)
    for row, (trained, title) in zip(axes, WAYS.items(), strict=True):
        for axis, (knob, each) in zip(row, on.knobs.items(), strict=True):
            for results in on.methods(trained):
                shown = [d for d in (Dose(), *each) if len(on.returns(results.name, d, trained))]
                found = [estimate(on.returns(results.name, dose, trained)) for dose in shown]
                sizes = [dose.size for dose in shown]
                axis.plot(sizes, [e.value for e in found], "o-", markersize=3, **style_of(results))
                shade = {"color": color(results.method), "alpha": 0.15, "linewidth": 0}
                axis.fill_between(sizes, [e.low for e in found], [e.high for e in found], **shade)
            axis.set(title=title, xlabel=UNITS.get(knob, knob.replace("_", " ")), ylabel="return")
    for column in axes.T:
        share_limits(column)
    legend(axes[0, 0])
    return figure


def cost(tasks: Mapping[str, TaskResults], costs: Mapping[str, Mapping[str, float]]) -> Figure:
    """Variation between equivalent goals over what training costs, a panel per task.

    Args:
        tasks: results by title.
        costs: of a step, by the task's name and method (`study_costs.py`).
    """
    figure, axes = grid(1, len(tasks), 5.0, 3.6)
    for axis, (title, task) in zip(axes[0], tasks.items(), strict=True):
        axis.set_yscale("log")
        of = costs[task.name]
        for results in task.values():
            values = np.maximum(results.variation(), LEAST_VARIATION)
            found = estimate(np.log10(values))
            x, y = of[results.name] / of["ppo"], 10**found.value
            reach = [[y - 10**found.low], [10**found.high - y]] if np.isfinite(found.low) else None
            style = {"color": color(results.method), "label": results.label}
            axis.errorbar(x, y, reach, fmt="o", markersize=5, linewidth=1, **style)
        axis.set(title=title, xlabel="processor time of a step, of PPO's", ylabel="variation of the return")
        axis.legend(frameon=False, fontsize=7.5, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def save(figure: Figure, path) -> None:
    """Write a figure and let go of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
