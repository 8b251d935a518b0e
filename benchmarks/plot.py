"""Draws every figure and table of a comparison from its stored results alone.

    python benchmarks/plot.py paper-cartpole-20

Figures: `training` (the paper's learning curves of return and symmetry loss), `log_prob` (its log action
probabilities of augmented samples, original rule against naive), `initialization` (its study of initial
weights), `goals` (Table I seed by seed), `efficiency` (seeds that reached a return, over steps and time),
`success` (of training, and the curriculum), `phases` (every seed's return through the curriculum's phases).
Lines are interquartile means over seeds, bands their 95 % bootstrap intervals. `tables.md` has the numbers.
"""

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.axes import Axes

from comparison.intervals import band, iqm
from comparison.methods import Method
from comparison.study import MethodResults, Study, TaskResults, read
from comparison.tables import tables

HERE = Path(__file__).parent
COLORS = {
    "ppo": "tab:orange",
    "aug": "tab:blue",
    "aug-random": "tab:cyan",
    "aug-naive": "tab:red",
    "aug-naive-raw": "tab:brown",
    "equivariant": "black",
    "relaxed": "tab:pink",
}
SHADES = {"ppo": "Greens", "aug": "Purples"}  # with a mirror loss, darker for larger weights
STEPS = "million environment steps"
SCALES = "viridis"  # initial weights, from small to large


def draw_all(results: Path, plots: Path) -> list[Path]:
    """Draw everything that the results have; returns what was written."""
    study = read(results)
    plots.mkdir(parents=True, exist_ok=True)
    figures = (training, log_prob, initialization, goals, efficiency, success, phases)
    if all("@" in task for task in study):  # doses of an asymmetry: plot_study.py draws those
        figures = ()
    written = []
    for draw in figures:
        name, figure = draw.__name__, draw(study)
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


def color(method: Method):
    """A method's colour: hue for data and network, shade for the weight of the mirror loss."""
    if not method.weight or method.base not in SHADES:
        return COLORS[method.base]
    shade = np.clip(0.65 + 0.17 * np.log10(method.weight), 0.3, 1.0)
    return matplotlib.colormaps[SHADES[method.base]](shade)


def style_of(results: MethodResults) -> dict[str, Any]:
    """How the lines of a method are drawn."""
    return {"color": color(results.method), "label": results.label, "linewidth": 1.4}


def draw_curve(axis: Axes, results: MethodResults, column: str, **style) -> None:
    """Interquartile mean and interval over environment steps; of the logarithm where the axis has one."""
    curve = results.curve(column)
    curve = curve[np.isfinite(curve).all(axis=1)]
    if curve.empty:
        return
    steps, values = curve.index.to_numpy(), np.ascontiguousarray(curve.to_numpy().T)
    logarithmic = axis.get_yscale() == "log"
    if logarithmic:
        values = np.log(np.maximum(values, 1e-12))
    lines = [iqm(values), *band(values)]
    middle, low, high = (np.exp(line) for line in lines) if logarithmic else lines
    axis.plot(steps, middle, **style_of(results) | style)
    axis.fill_between(steps, low, high, color=axis.lines[-1].get_color(), alpha=0.15, linewidth=0)


def training(study: Study):
    """Return and symmetry loss over environment steps, a column per task."""
    figure, panels = pairs(len(study))
    for (top, bottom), task in zip(panels, study.values(), strict=True):
        bottom.set_yscale("log")
        for results in compared(task):
            draw_curve(top, results, "return")
            draw_curve(bottom, results, "mirror_loss")
        top.set(title=task.name, xlabel=STEPS, ylabel="training return")
        bottom.set(xlabel=STEPS, ylabel="symmetry loss")
        legend(top)
    return figure


def log_prob(study: Study):
    """Log-probabilities in the denominator, mean over augmented samples; a cross where a seed diverged."""
    rules = {"aug": "log_prob", "aug-naive": "log_prob_copies", "aug-naive-raw": "log_prob_copies"}
    shown = [task for task in study.values() if {"aug", "aug-naive"} <= set(task)]
    if not shown:
        return None
    figure, panels = pairs(len(shown))
    for (top, bottom), task in zip(panels, shown, strict=True):
        for results in (task[name] for name in rules if name in task):
            column, style = rules[results.name], {"linewidth": 0.8, "alpha": 0.8}
            style["color"] = color(results.method)
            for seed, own in results.curves.items():
                top.plot(own["frames"] / 1e6, own[column], **style)
                if seed in results.diverged:
                    top.plot(own["frames"].iloc[-1] / 1e6, own[column].iloc[-1], "x", **style)
            top.plot([], [], color=color(results.method), label=results.label)
            draw_curve(bottom, results, "return")
        if top.get_ylim()[0] < -100:
            top.set_yscale("symlog", linthresh=10)
            top.set_ylim(top=5.0)
        what = f"{task.name}: log-probability in the denominator"
        top.set(title=what, xlabel=STEPS, ylabel="mean over augmented samples")
        bottom.set(xlabel=STEPS, ylabel="training return")
        legend(top)
    return figure


def initialization(study: Study):
    """Return and symmetry loss by initial weights (dashed: symmetric), without and with a mirror loss."""
    groups: dict[tuple[str, Method], list[MethodResults]] = {}
    for task in study.values():
        for results in task.values():
            groups.setdefault((task.name, ordinary(results.method)), []).append(results)
    groups = {key: every for key, every in groups.items() if any(m.method != key[1] for m in every)}
    if not groups:
        return None
    figure, axes = grid(2, len(groups), 4.6)
    scales = sorted({results.method.scale for every in groups.values() for results in every})
    for (top, bottom), ((task, base), every) in zip(axes.T, groups.items(), strict=True):
        bottom.set_yscale("log")
        for results in sorted(every, key=lambda m: m.method.scale):
            scale, symmetric = results.method.scale, results.method.initialization == "symmetric"
            shade = scales.index(scale) / max(1, len(scales) - 1) * 0.85
            style = {"color": matplotlib.colormaps[SCALES](shade), "linestyle": "--" if symmetric else "-"}
            style["label"] = "symmetric " * symmetric + f"init-{scale:g}"
            draw_curve(top, results, "return", **style)
            draw_curve(bottom, results, "mirror_loss", **style)
        top.set(title=f"{task}: {base.label}", ylabel="training return")
        bottom.set(xlabel=STEPS, ylabel="symmetry loss")
        legend(top)
    for row in axes:
        share_limits(row)
    return figure


def ordinary(method: Method) -> Method:
    """The same method from ordinary initial weights."""
    return dataclasses.replace(method, scale=1.0, initialization="default")


def share_limits(axes: Iterable[Axes]) -> None:
    """The same vertical range for panels that are compared."""
    limits = [axis.get_ylim() for axis in axes]
    for axis in axes:
        axis.set_ylim(min(low for low, _ in limits), max(high for _, high in limits))


def success(study: Study):
    """Success and level of the curriculum while training."""
    shown = [task for task in study.values() if task.has_curriculum]
    if not shown:
        return None
    figure, panels = pairs(len(shown))
    for (top, bottom), task in zip(panels, shown, strict=True):
        for results in compared(task):
            draw_curve(top, results, "success")
            draw_curve(bottom, results, "level")
        top.set(title=task.name, xlabel=STEPS, ylabel="success in training", ylim=(0, 1))
        bottom.set(xlabel=STEPS, ylabel="level of the curriculum")
        legend(bottom)
    return figure


def phases(study: Study):
    """Every seed's training return, with a tick where its curriculum enters another phase.

    The letter is where the median seed enters it.
    """
    with_phases = [results for task in study.values() if task.has_phases for results in compared(task)]
    shown = [m for m in with_phases if any(np.isfinite(c["phase"]).any() for c in m.curves.values())]
    if not shown:
        return None
    columns = min(len(shown), 3)
    figure, axes = grid(math.ceil(len(shown) / columns), columns, 4.2, 2.9)
    used, unused = axes.flat[: len(shown)], axes.flat[len(shown) :]
    for axis, results in zip(used, shown, strict=True):
        style = {"color": color(results.method), "linewidth": 0.9, "alpha": 0.8}
        for own in results.curves.values():
            axis.plot(own["frames"] / 1e6, own["return"], **style)
            entered = own[own["phase"].diff() > 0]
            axis.plot(entered["frames"] / 1e6, entered["return"], "|", color="black", markersize=9)
        axis.set(title=f"{results.task.name}: {results.label}", xlabel=STEPS)
        for number, name in enumerate("BC", 1):
            starts = [c["frames"][c["phase"] >= number].min() for c in results.curves.values()]
            if np.isfinite(starts).any():
                middle = np.nanmedian(starts) / 1e6
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
    figure, axes = grid(1, len(study), 6.4, 4.2)
    markers = "><^vDs"
    for axis, task in zip(axes[0], study.values(), strict=True):
        legend_goals: list[str] = []
        succeeds = task.has_success
        for place, results in enumerate(task.values()):
            evaluated, shade = results.evaluated("success" if succeeds else "return"), color(results.method)
            values = evaluated.to_numpy()
            offsets = np.linspace(-0.3, 0.3, len(values)) if len(values) > 1 else np.zeros(len(values))
            for x, row in zip(place + offsets, values, strict=True):
                axis.plot([x, x], [row.min(), row.max()], color=shade, linewidth=1, alpha=0.6)
                for marker, value in zip(markers, row, strict=False):
                    axis.plot(x, value, marker, color=shade, markersize=3.5, markeredgewidth=0)
            legend_goals = list(evaluated) or legend_goals
        labels = [results.label for results in task.values()]
        axis.set_xticks(range(len(labels)), labels, rotation=40, ha="right", fontsize=7.5)
        what = ", ".join(f"{m} {name}" for m, name in zip("▸◂▴▾◆■", legend_goals, strict=False))
        figure_of = "success rate" if succeeds else "mean return"
        axis.set(title=f"{task.name}: {what}", ylabel=f"{figure_of} of a goal, per seed")
        axis.grid(axis="x", visible=False)
    return figure


def efficiency(study: Study):
    """Share of seeds whose progress has reached a threshold, over steps and over seconds."""
    figure, panels = pairs(len(study))
    for (top, bottom), task in zip(panels, study.values(), strict=True):
        for results in compared(task):
            curves = results.progress.values()
            if not curves:
                continue
            ends = np.max([c[["frames", "seconds"]].iloc[-1] for c in curves], axis=0) / (1e6, 1)
            for axis, reached, end in zip((top, bottom), results.crossings.T, ends, strict=True):
                x = np.sort(reached[np.isfinite(reached)])
                share = np.arange(len(x) + 1) / len(reached)
                axis.step([0.0, *x, end], [*share, share[-1]], where="post", **style_of(results))
        title = f"{task.name}: {task.measured} ≥ {task.threshold:.2f}"
        top.set(title=title, xlabel=STEPS, ylabel="share of seeds")
        bottom.set(xlabel="seconds on one core", ylabel="share of seeds")
        legend(top)
    return figure


def compared(task: TaskResults) -> list[MethodResults]:
    """Methods that learn from ordinary initial weights: those of the paper's training figure.

    What one seed only has tried is in the tables; here it would look like the others.
    """
    few = min(2, max(len(results.seeds) for results in task.values()))
    usual = [m for m in task.values() if m.method == ordinary(m.method) and m.method.family != "aug-naive"]
    return [results for results in usual if len(results.seeds) >= few]


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
