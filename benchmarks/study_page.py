"""Writes docs/study.md: networks, copies and losses on symmetric tasks, and under a dose of asymmetry.

    python benchmarks/study_page.py

Prose is in `templates/study.md`, every number is of `benchmarks/results/study-*`, which
`compare.py --preset study-...` writes; rules of the verdicts are in `comparison/network_claims.py` and
`comparison/doses.py`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import jinja2
import numpy as np
import tyro

import plot_study
from comparison import doses, network_claims
from comparison.files import write_whole
from comparison.markdown import markdown
from comparison.progress import SHARE, SMOOTHING
from comparison.study import Study, TaskResults, read
from comparison.tables import success_table, table_1
from results_page import command, prose

HERE = Path(__file__).parent
TASKS = {
    "study-cartpole": ("cartpole", "CartPole"),
    "study-push": ("anymal_push", "ANYmal-Push"),
    "study-repose": ("trifinger_repose", "Trifinger-Repose"),
    "study-repose-yaw": ("repose_yaw:make_env", "Trifinger-Repose with heading"),
    "study-climb": ("anymal_climb", "ANYmal-Climb"),
}
"""Studies of symmetric tasks: which task each is of, and its title."""
DOSED = {"study-cartpole": "study-cartpole-doses", "study-push": "study-push-doses"}
"""The studies of the same tasks under a dose of asymmetry."""
COST = """What symmetry costs, and what is left of the asymmetry: variation of the evaluated return between
    equivalent goals, over the processor time of a training step (interquartile means, 95 % intervals).
    Better is down and left."""
DOSES = """Return over the dose, mean over the equivalent goals: interquartile mean over seeds with its 95 %
    interval."""


@dataclass
class Arguments:
    """Write the page of the study."""

    results: Path = HERE / "results"
    """Where results are stored."""
    docs: Path = HERE.parent / "docs"
    """Where study.md goes."""
    plots: Path = HERE / "plots" / "study"
    """Where its figures go."""


Costs = dict[str, dict[str, float]]
"""Processor seconds per million steps, by task and method."""


def page(studies: dict[str, Study], costs: Costs, plots: Path | None = None) -> str:
    """The whole page.

    Args:
        studies: those that there are, by name.
        costs: of `study_costs.py`.
        plots: where its figures are drawn; None to leave them as they are.
    """
    names = [name for name in TASKS if name in studies]
    dosed = {
        name: doses.Doses(studies[name][TASKS[name][0]], studies[under])
        for name, under in DOSED.items()
        if {name, under} <= studies.keys()
    }
    if plots is not None:
        tasks = {TASKS[name][1]: studies[name][TASKS[name][0]] for name in names}
        plot_study.save(plot_study.cost(tasks, costs), plots / "cost.png")
        for on in dosed.values():
            plot_study.save(plot_study.doses(on), plots / f"{on.without.name}.png")
    loader = jinja2.FileSystemLoader(HERE / "templates")
    template = jinja2.Environment(loader=loader, undefined=jinja2.StrictUndefined, autoescape=False)
    return template.get_template("study.md").render(
        figures={"cost": _figure("cost", COST)},
        symmetric=[_symmetric(name, studies[name], costs) for name in names],
        dosed=[_dosed(name, on) for name, on in dosed.items()],
    )


def _symmetric(name: str, study: Study, costs: Costs) -> dict[str, str]:
    """One symmetric task: verdicts, and the numbers behind them."""
    of, title = TASKS[name]
    task = study[of]
    return {
        "title": title,
        "made": _made(name, study),
        "verdicts": network_claims.table(task),
        "numbers": success_table(task) if task.has_success else table_1(task),
        "efficiency": efficiency_table(task, costs[of]),
    }


def efficiency_table(task: TaskResults, costs: dict[str, float]) -> str:
    """Steps, and processor time, until a training has come so far."""
    head = ["method", "reached", "million steps", "seconds", "seconds per million", "of plain PPO's"]
    rows = []
    for results in task.values():
        steps, seconds = float(np.median(results.crossings[:, 0])), costs[results.name]
        there = [f"{steps:.2f}", f"{steps * seconds:.0f}"] if np.isfinite(steps) else ["-", "-"]
        count = "{} of {}".format(*results.reached)
        share = f"{seconds / costs['ppo']:.2f}"
        rows.append([results.label, count, *there, f"{seconds:.1f}", share])
    note = prose(f"""Median over seeds until the {task.measured}, averaged over {SMOOTHING} logged
        iterations, reaches {task.threshold:.2f}: {SHARE:.0%} of the way from its first value to the best
        method's last. Seconds are processor time of one core, measured with all methods in turn
        (`python benchmarks/study_costs.py`).""")
    return f"{markdown(head, rows)}\n{note}\n"


def _dosed(name: str, on: doses.Doses) -> dict[str, object]:
    """One task under doses of asymmetry."""
    return {
        "title": TASKS[name][1],
        "made": _made(DOSED[name], on.under),
        "figure": _figure(on.without.name, DOSES),
        "verdicts": doses.table(on),
        "returns": {
            way[0].upper() + way[1:]: doses.returns_table(on, trained)
            for trained, way in plot_study.WAYS.items()
        },
    }


def _made(name: str, study: Study) -> str:
    """With what the numbers were made."""
    seeds = sorted({len(results.seeds) for task in study.values() for results in task.values()})
    text = f"""`{command(name)}` at {", ".join(study.about["revisions"])}: {study.trained} runs of
        {study.million_steps:.1f} million steps, {seeds[0]} to {seeds[-1]} seeds per row,
        {study.hours:.1f} hours of one core; {study.about["machine"]}."""
    if missing := study.about.get("unfinished"):
        text += f""" **Still in progress**: {len(missing)} runs are missing, verdicts are preliminary."""
    return prose(text)


def _figure(name: str, caption: str) -> str:
    return f"![{name}](../benchmarks/plots/study/{name}.png)\n\n{prose(f'*{caption}*')}\n"


def stored(results: Path) -> tuple[dict[str, Study], Costs]:
    """The studies that there are, and what their methods cost."""
    names = [*TASKS, *DOSED.values()]
    known = {name: read(results / name) for name in names if (results / name).exists()}
    return known, json.loads((results / "study-costs.json").read_text())["costs"]


def main(arguments: Arguments) -> None:
    studies, costs = stored(arguments.results)
    write_whole(arguments.docs / "study.md", page(studies, costs, arguments.plots))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
