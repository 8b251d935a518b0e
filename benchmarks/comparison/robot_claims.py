"""The paper's claims that every robot task can decide, judged by the rules of `verdicts.py`.

Returns, successes and turning are those of mean actions, in episodes whose starts are paired: between goals
an equivariant policy differs by nothing, another one also by chance, of which the claim of success takes an
upper bound off. Sampled actions are in the tables. A claim whose methods are not in the study, or whose
figures a task does not have, is left out.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from comparison.intervals import difference, iqm
from comparison.methods import label, parts
from comparison.study import Study
from comparison.tables import chance_variation, markdown, measured, threshold
from comparison.verdicts import (
    Claims,
    Judgement,
    counted,
    joined,
    no_gain,
    pair,
    recovery,
    returns,
    steps,
    symmetry_loss,
    variations,
    verdict,
)

FIGURES = {"return": "return", "task_return": "task return", "success": "success"}
NO_DIFFERENCE = 0.05  # of the return of augmentation: what a mirror loss beside it may add

claim = CLAIMS = Claims()


@dataclass(frozen=True)
class Results:
    """One evaluation of one task of a study."""

    study: Study
    task: str
    what: str

    def evaluated(self, of: Callable, column: str = "return") -> Callable:
        """A figure of mean actions, to be handed to `pair`."""
        return partial(of, task=self.task, what=self.what, column=column)

    def seeds(self, method: str, column: str = "return") -> int:
        """How many seeds of a method were evaluated."""
        values = self.study.goal_returns(self.task, method, column, what=self.what)[1]
        return int(np.isfinite(values).all(axis=1).sum())

    def chance(self, method: str) -> np.ndarray:
        """Variation of success that chance explains, of every seed, at most."""
        rates = self.study.goal_returns(self.task, method, "success", what=self.what)[1]
        return chance_variation(rates, min(self.study.about["episodes"]))

    def losses(self, least: int = 2) -> list[str]:
        """The methods with nothing but a mirror loss, and so many seeds."""
        found = [m for m in self.study.methods(self.task) if parts(m)[0] == "ppo" and parts(m)[1]]
        return [m for m in found if self.seeds(m) >= least]

    def left_out(self) -> str:
        """Which mirror losses are not compared, as text that can be appended."""
        names = [label(m) for m in self.losses(1) if m not in self.losses()]
        return f"; not compared, of one seed: {', '.join(names)}" if names else ""

    def with_loss(self) -> str | None:
        """The method with augmentation and a mirror loss, if there is one."""
        found = [m for m in self.study.methods(self.task) if parts(m)[0] == "aug" and parts(m)[1]]
        return next((m for m in found if self.seeds(m) > 1), None)


def figures(results: Results) -> dict[str, str]:
    """Those of return, task return and success that the task has."""
    return {column: name for column, name in FIGURES.items() if results.seeds("aug", column)}


@claim("Augmentation yields the highest return.", "Table I", "ppo", "aug")
def _return(results: Results) -> Judgement:
    texts, outcomes = [], {}
    for column, name in figures(results).items():
        text, gap = pair(results.study, results.evaluated(returns, column), "aug", "ppo")
        texts.append(f"{name}: {text}")
        outcomes[column] = verdict(gap)
    for loss in results.losses():
        text, gap = pair(results.study, results.evaluated(returns), "aug", loss)
        texts.append(f"return: {text}")
        outcomes[f"than {loss}"] = verdict(gap)
    return "; ".join(texts) + results.left_out(), joined(**outcomes)


@claim("Augmentation makes the variation between equivalent goals much lower.", "Table I", "ppo", "aug")
def _variation(results: Results) -> Judgement:
    texts, outcomes = [], {}
    for column, name in figures(results).items():
        of = results.evaluated(variations, column)
        text, gap = pair(results.study, of, "ppo", "aug")
        plain, copies = (of(results.study, method) for method in ("ppo", "aug"))
        text += f", ratio of means {plain.mean() / max(copies.mean(), 1e-12):.1f}"
        if column == "success":
            chance = results.chance("ppo")
            certain = difference(plain - chance, copies)
            text += f"; without what chance explains of PPO's, {chance.mean():.3f} at most: "
            text += certain.format()
            gap = dataclasses.replace(gap, low=certain.low)  # an upper bound confirms, it does not refute
        texts.append(f"{name}: {text}")
        outcomes[column] = verdict(gap)
    return "; ".join(texts), joined(**outcomes)


@claim("Augmentation keeps the symmetry loss low.", "Sec. IV-C", "ppo", "aug", figure=None)
def _low_loss(results: Results) -> Judgement:
    plain, copies = (symmetry_loss(results.study, m, task=results.task) for m in ("ppo", "aug"))
    gap = difference(plain, copies)
    text = f"PPO {10 ** iqm(plain):.2g}, PPO + aug. {10 ** iqm(copies):.2g}; orders of magnitude "
    return text + gap.format(1), verdict(gap)


@claim("Augmentation converges fastest.", "Sec. IV-C, Fig. 4", "ppo", "aug", figure=None)
def _speed(results: Results) -> Judgement:
    of = partial(steps, task=results.task)
    texts, outcomes = [], {}
    for slower in ("ppo", *results.losses()):
        text, gap = pair(results.study, of, slower, "aug", 2)
        texts.append(text)
        outcomes[f"than {slower}"] = verdict(gap)
    what, goal = measured(results.study, results.task), threshold(results.study, results.task)
    counts = ", ".join(counted(results.study, m, task=results.task) for m in ("ppo", "aug"))
    evidence = f"million steps to a {what} of {goal:.2f} ({counts} seeds; those that never do count with "
    return f"{evidence}the whole curriculum): {'; '.join(texts)}{results.left_out()}", joined(**outcomes)


@claim("When starts get any heading, augmentation recovers sooner.", "Sec. IV-C, Fig. 4", "ppo",
       "aug", figure=None)  # fmt: skip
def _recovery(results: Results) -> Judgement | None:
    curves = results.study.curves_of_task(results.task)
    if not any(np.isfinite(curve.get("phase", np.nan)).any() for curve in curves):
        return None
    every = {m: recovery(results.study, m, task=results.task) for m in ("ppo", "aug")}
    entered = {m: taken[np.isfinite(taken)] for m, taken in every.items()}
    counts = ", ".join(f"{label(m)} {len(entered[m])} of {len(every[m])}" for m in every)
    if not all(len(taken) for taken in entered.values()):
        return f"seeds that enter phase C: {counts}", "undecided"
    text, gap = pair(results.study, lambda _, method: entered[method], "ppo", "aug", 2)
    evidence = f"million steps from the start of phase C ({counts} seeds enter it) to nine tenths of what "
    return f"{evidence}is regained: {text}", verdict(gap)


@claim("Without augmentation, the robot turns round to use its favourite limbs.", "Sec. IV-F", "ppo", "aug",
       figure="turning")  # fmt: skip
def _turning(results: Results) -> Judgement:
    text, gap = pair(results.study, results.evaluated(returns, "turning"), "ppo", "aug", 2)
    return f"yaw travelled in an episode, to and fro, gait included, rad: {text}", verdict(gap)


@claim("Adding a mirror loss to augmentation does not help.", "Sec. IV-C", "aug")
def _both(results: Results) -> Judgement | None:
    both = results.with_loss()
    if both is None:
        return None
    text, gain = pair(results.study, results.evaluated(returns), both, "aug")
    margin = _margin(results)
    return f"return: {text}; margin {margin:.2f}", no_gain(gain, margin)


@claim("One random element per sample is as good as all of them.", "not in the paper", "aug", "aug-random",
       "ppo")  # fmt: skip
def _random(results: Results) -> Judgement:
    text, loss = pair(results.study, results.evaluated(returns), "aug", "aug-random")
    margin = _margin(results)
    return f"return: {text}; margin {margin:.2f}", no_gain(loss, margin)


def _margin(results: Results) -> float:
    return NO_DIFFERENCE * abs(float(iqm(results.evaluated(returns)(results.study, "aug"))))


def table(study: Study, task: str, what: str | None = None) -> str:
    """The claims with evidence and verdict, as Markdown.

    Args:
        study: the results.
        task: one of its tasks.
        what: one of the task's evaluations; the first by default.
    """
    rows = [*CLAIMS.HEAD]
    results = Results(study, task, what or study.evaluations(task)[0])
    first = results.what == study.evaluations(task)[0]
    for each in CLAIMS:
        if each.figure is None and not first:  # training is the same
            continue
        if not set(each.methods) <= set(study.methods(task)):
            continue
        lost = [label(m) for m in each.methods if not results.seeds(m)]
        if lost:
            rows.append([each.text, each.place, f"no seed of {', '.join(lost)} was evaluated", "-"])
            continue
        if each.figure and not results.seeds("aug", each.figure):
            continue
        judgement = each.judge(results)
        if judgement is not None:
            rows.append(each.row(judgement))
    return markdown(rows)
