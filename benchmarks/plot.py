"""Draws every figure and table of a comparison from its stored results alone.

    python benchmarks/plot.py paper-cartpole-20

Figures: `training` (the paper's learning curves of return and symmetry loss), `log_prob` (its log action
probabilities of augmented samples, original rule against naive), `initialization` (its study of initial
weights), `goals` (Table I seed by seed), `efficiency` (seeds that reached a return, over steps and time),
`success` (of training, and the curriculum), `phases` (every seed's return through the curriculum's phases).
Lines are interquartile means over seeds, bands their 95 % bootstrap intervals. `tables.md` has the numbers.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.axes import Axes

from comparison.intervals import band, iqm
from comparison.methods import label, parts
from comparison.robot_tables import has_success, tables
from comparison.study import Study, has_curriculum, read
from comparison.tables import crossings, measured, threshold

HERE = Path(__file__).parent
COLORS = {
    "ppo": "tab:orange",
    "aug": "tab:blue",
    "aug-random": "tab:cyan",
    "aug-naive": "tab:red",
    "aug-naive-raw": "tab:brown",
}
SHADES = {"ppo": "Greens", "aug": "Purples"}  # with a mirror loss, darker for larger weights
STEPS = "million environment steps"
SCALES = "viridis"  # initial weights, from small to large


def draw_all(results: Path, plots: Path) -> list[Path]:
    """Draw everything that the results have; returns what was written."""
    study = read(results)
    plots.mkdir(parents=True, exist_ok=True)
    drawn = {
        "training": training(study),
        "log_prob": log_prob(study),
        "initialization": initialization(study),
        "goals": goals(study),
        "efficiency": efficiency(study),
        "success": success(study),
        "phases": phases(study),
    }
    written = []
    for name, figure in drawn.items():
        if figure is not None:
            written.append(plots / f"{name}.png")
            figure.savefig(written[-1], dpi=110)
            plt.close(figure)
    written.append(plots / "tables.md")
    written[-1].write_text(tables(study))
    return written


def grid(rows: int, columns: int, width: float = 4.0, height: float = 2.9):
    """Empty panels without frames."""
    size = (width * columns, height * rows)
    figure, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25, linewidth=0.5)
    return figure, axes


def pairs(columns: int, width: float = 5.2):
    """Two panels per column, one above the other; side by side if there is but one column."""
    if columns == 1:
        figure, axes = grid(1, 2, width, 3.4)
        return figure, [tuple(axes[0])]
    figure, axes = grid(2, columns, width)
    return figure, [tuple(column) for column in axes.T]


def color(method: str):
    """A method's colour: hue for the augmentation, shade for the weight of the mirror loss."""
    augmentation, weight, _ = parts(method)
    if not weight or augmentation not in SHADES:
        return COLORS[augmentation]
    return matplotlib.colormaps[SHADES[augmentation]](np.clip(0.65 + 0.17 * np.log10(weight), 0.3, 1.0))


def draw_curve(axis: Axes, study: Study, task: str, method: str, column: str, **style) -> None:
    """Interquartile mean and interval over environment steps; of the logarithm where the axis has one."""
    steps, values = study.curve(task, method, column)
    logarithmic = axis.get_yscale() == "log"
    if logarithmic:
        values = np.log(np.maximum(values, 1e-12))
    known = np.isfinite(values).all(axis=0)
    if not len(values) or not known.any():
        return
    steps, values = steps[known], values[:, known]
    lines = [iqm(values), *band(values)]
    middle, low, high = (np.exp(line) for line in lines) if logarithmic else lines
    axis.plot(steps, middle, linewidth=1.4, **{"color": color(method), "label": label(method)} | style)
    axis.fill_between(steps, low, high, color=axis.lines[-1].get_color(), alpha=0.15, linewidth=0)


def training(study: Study):
    """Return and symmetry loss over environment steps, a column per task."""
    figure, panels = pairs(len(study.tasks))
    for (top, bottom), task in zip(panels, study.tasks, strict=True):
        bottom.set_yscale("log")
        for method in compared(study, task):
            draw_curve(top, study, task, method, "return")
            draw_curve(bottom, study, task, method, "mirror_loss")
        top.set(title=task, xlabel=STEPS, ylabel="training return")
        bottom.set(xlabel=STEPS, ylabel="symmetry loss")
        legend(top)
    return figure


def log_prob(study: Study):
    """Log-probabilities in the denominator, mean over augmented samples; a cross where a seed diverged."""
    rules = {"aug": "log_prob", "aug-naive": "log_prob_copies", "aug-naive-raw": "log_prob_copies"}
    shown = [task for task in study.tasks if {"aug", "aug-naive"} <= set(study.methods(task))]
    if not shown:
        return None
    figure, panels = pairs(len(shown))
    for (top, bottom), task in zip(panels, shown, strict=True):
        for method, column in rules.items():
            if method not in study.methods(task):
                continue
            style = {"color": color(method), "linewidth": 0.8, "alpha": 0.8}
            diverged = study.diverged(task, method)
            for seed, own in study.curves_of(task, method).items():
                top.plot(own["frames"] / 1e6, own[column], **style)
                if seed in diverged:
                    top.plot(own["frames"][-1] / 1e6, own[column][-1], "x", **style)
            top.plot([], [], color=color(method), label=label(method))
            draw_curve(bottom, study, task, method, "return")
        if top.get_ylim()[0] < -100:
            top.set_yscale("symlog", linthresh=10)
            top.set_ylim(top=5.0)
        what = f"{task}: log-probability in the denominator"
        top.set(title=what, xlabel=STEPS, ylabel="mean over augmented samples")
        bottom.set(xlabel=STEPS, ylabel="training return")
        legend(top)
    return figure


def initialization(study: Study):
    """Return and symmetry loss by the scale of the initial weights, without and with a mirror loss."""
    groups: dict[tuple[str, str], list[str]] = {}
    for task in study.tasks:
        scaled = {method.split("+init-")[0] for method in study.methods(task) if "+init-" in method}
        for method in study.methods(task):
            base = method.split("+init-")[0]
            if base in scaled:
                groups.setdefault((task, base), []).append(method)
    if not groups:
        return None
    figure, axes = grid(2, len(groups), 4.6)
    scales = sorted({parts(method)[2] for methods in groups.values() for method in methods})
    for (top, bottom), ((task, base), methods) in zip(axes.T, groups.items(), strict=True):
        bottom.set_yscale("log")
        for method in sorted(methods, key=lambda m: parts(m)[2]):
            scale = parts(method)[2]
            shade = scales.index(scale) / max(1, len(scales) - 1) * 0.85
            style = {"color": matplotlib.colormaps[SCALES](shade), "label": f"init-{scale:g}"}
            draw_curve(top, study, task, method, "return", **style)
            draw_curve(bottom, study, task, method, "mirror_loss", **style)
        top.set(title=f"{task}: {label(base)}", ylabel="training return")
        bottom.set(xlabel=STEPS, ylabel="symmetry loss")
        legend(top)
    for row in axes:
        share_limits(row)
    return figure


def share_limits(axes: Iterable[Axes]) -> None:
    """The same vertical range for panels that are compared."""
    limits = [axis.get_ylim() for axis in axes]
    for axis in axes:
        axis.set_ylim(min(low for low, _ in limits), max(high for _, high in limits))


def success(study: Study):
    """Success and level of the curriculum while training."""
    shown = [task for task in study.tasks if any(map(has_curriculum, study.curves_of_task(task)))]
    if not shown:
        return None
    figure, panels = pairs(len(shown))
    for (top, bottom), task in zip(panels, shown, strict=True):
        for method in compared(study, task):
            draw_curve(top, study, task, method, "success")
            draw_curve(bottom, study, task, method, "level")
        top.set(title=task, xlabel=STEPS, ylabel="success in training", ylim=(0, 1))
        bottom.set(xlabel=STEPS, ylabel="level of the curriculum")
        legend(bottom)
    return figure


def phases(study: Study):
    """Every seed's training return, with a tick where its curriculum enters another phase.

    The letter is where the median seed enters it.
    """
    shown = [
        (task, method)
        for task in study.tasks
        for method in compared(study, task)
        if any(np.isfinite(c.get("phase", np.nan)).any() for c in study.curves_of(task, method).values())
    ]
    if not shown:
        return None
    columns = min(len(shown), 3)
    figure, axes = grid(math.ceil(len(shown) / columns), columns, 4.2, 2.9)
    used, unused = axes.flat[: len(shown)], axes.flat[len(shown) :]
    for axis, (task, method) in zip(used, shown, strict=True):
        for own in study.curves_of(task, method).values():
            steps = own["frames"] / 1e6
            axis.plot(steps, own["return"], color=color(method), linewidth=0.9, alpha=0.8)
            entered = np.flatnonzero(np.diff(own["phase"]) > 0) + 1
            axis.plot(steps[entered], own["return"][entered], "|", color="black", markersize=9)
        axis.set(title=f"{task}: {label(method)}", xlabel=STEPS)
        for number, name in enumerate("BC", 1):
            own = [c for c in study.curves_of(task, method).values() if (c["phase"] >= number).any()]
            if own:
                middle = np.median([c["frames"][(c["phase"] >= number).argmax()] for c in own]) / 1e6
                axis.axvline(middle, color="black", linewidth=0.6, linestyle=":")
                place = (middle, 1.0)
                axis.annotate(name, place, (2, -9), axis.get_xaxis_transform(), "offset points", fontsize=8)
    for axis in axes[:, 0]:
        axis.set_ylabel("training return, per seed")
    for axis in unused:
        axis.set_axis_off()
    share_limits(used)
    return figure


def goals(study: Study):
    """Evaluated return of every equivalent goal, one vertical line per seed; success where there is one."""
    figure, axes = grid(1, len(study.tasks), 6.4, 4.2)
    markers = "><^vDs"
    for axis, task in zip(axes[0], study.tasks, strict=True):
        methods, legend_goals = study.methods(task), []
        succeeds = has_success(study, task)
        column = "success" if succeeds else "return"
        for place, method in enumerate(methods):
            names, values = study.goal_returns(task, method, column)
            offsets = np.linspace(-0.3, 0.3, len(values)) if len(values) > 1 else np.zeros(len(values))
            for x, row in zip(place + offsets, values, strict=True):
                axis.plot([x, x], [row.min(), row.max()], color=color(method), linewidth=1, alpha=0.6)
                for marker, value in zip(markers, row, strict=False):
                    axis.plot(x, value, marker, color=color(method), markersize=3.5, markeredgewidth=0)
            legend_goals = names or legend_goals
        axis.set_xticks(
            range(len(methods)), [label(m) for m in methods], rotation=40, ha="right", fontsize=7.5
        )
        what = ", ".join(f"{m} {name}" for m, name in zip("▸◂▴▾◆■", legend_goals, strict=False))
        figure_of = "success rate" if succeeds else "mean return"
        axis.set(title=f"{task}: {what}", ylabel=f"{figure_of} of a goal, per seed")
        axis.grid(axis="x", visible=False)
    return figure


def efficiency(study: Study):
    """Share of seeds whose progress has reached a threshold, over steps and over seconds."""
    figure, panels = pairs(len(study.tasks))
    for (top, bottom), task in zip(panels, study.tasks, strict=True):
        goal = threshold(study, task)
        for method in compared(study, task):
            curves = study.with_progress(task, method).values()
            if not curves:
                continue
            ends = np.array([(c["frames"][-1] / 1e6, c["seconds"][-1]) for c in curves]).max(axis=0)
            style = {"color": color(method), "label": label(method), "where": "post", "linewidth": 1.4}
            for axis, reached, end in zip(
                (top, bottom), crossings(study, task, method, goal).T, ends, strict=True
            ):
                x = np.sort(reached[np.isfinite(reached)])
                share = np.arange(len(x) + 1) / len(reached)
                axis.step([0.0, *x, end], [*share, share[-1]], **style)
        top.set(
            title=f"{task}: {measured(study, task)} ≥ {goal:.2f}",
            xlabel=STEPS,
            ylabel="share of seeds",
        )
        bottom.set(xlabel="seconds on one core", ylabel="share of seeds")
        legend(top)
    return figure


def compared(study: Study, task: str) -> list[str]:
    """Methods that learn from ordinary initial weights: those of the paper's training figure.

    What one seed only has tried is in the tables; here it would look like the others.
    """
    seeds = {method: len(study.seeds(task, method)) for method in study.methods(task)}
    few = min(2, max(seeds.values()))
    ordinary = [m for m in seeds if parts(m)[2] == 1.0 and not parts(m)[0].startswith("aug-naive")]
    return [method for method in ordinary if seeds[method] >= few]


def legend(axis: Axes) -> None:
    if axis.get_legend_handles_labels()[0]:
        axis.legend(frameon=False, fontsize=7.5)


@dataclass
class Arguments:
    """Draw figures and tables from stored results."""

    name: tyro.conf.Positional[str] = "paper-cartpole-20"
    """What the results are called."""
    results: Path = HERE / "results"
    """Where results are, in a folder of their name."""
    plots: Path = HERE / "plots"
    """Where figures and tables go, in a folder of the results' name."""


if __name__ == "__main__":
    arguments = tyro.cli(Arguments)
    for path in draw_all(arguments.results / arguments.name, arguments.plots / arguments.name):
        print(f"wrote {path}")
