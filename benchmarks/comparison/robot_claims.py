"""The paper's claims that every robot task can decide, judged by the rules of `claims.py`.

Returns, successes and turning are those of sampled actions, as in training; mean actions are in the tables.
A claim whose methods have not been run, or whose figures a task does not have, is left out.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from comparison.claims import (
    Judgement,
    joined,
    no_gain,
    pair,
    returns,
    steps,
    symmetry_loss,
    variations,
    verdict,
)
from comparison.intervals import difference, iqm
from comparison.methods import parts
from comparison.study import Study
from comparison.tables import markdown, seconds_per_step

FIGURES = {"return": "return", "task_return": "task return", "success": "success"}
NO_DIFFERENCE = 0.05  # of the return of augmentation: what a mirror loss beside it may add

CLAIMS: list["RobotClaim"] = []


@dataclass(frozen=True)
class RobotClaim:
    """What the paper says, where, how it is judged, and what has to be there for it."""

    text: str
    place: str
    judge: Callable[[Study, str], Judgement]
    methods: tuple[str, ...]
    figure: str = "return"


def claim(text: str, place: str, *methods: str, figure: str = "return"):
    """Register a judge where it is defined."""

    def register(judge: Callable[[Study, str], Judgement]) -> Callable[[Study, str], Judgement]:
        CLAIMS.append(RobotClaim(text, place, judge, methods, figure))
        return judge

    return register


def sampled(what: Callable, task: str, column: str = "return") -> Callable:
    """A figure of sampled actions, to be handed to `pair`."""
    return partial(what, task=task, column=column, actions="sampled")


def weights(study: Study, task: str) -> list[str]:
    """The methods with nothing but a mirror loss, and as many seeds as plain PPO."""
    losses = [m for m in study.methods(task) if parts(m)[0] == "ppo" and parts(m)[1]]
    return [m for m in losses if len(study.seeds(task, m)) >= len(study.seeds(task, "ppo"))]


def with_loss(study: Study, task: str) -> str | None:
    """The method with augmentation and a mirror loss, if there is one."""
    found = [m for m in study.methods(task) if parts(m)[0] == "aug" and parts(m)[1]]
    return found[0] if found else None


def figures(study: Study, task: str) -> dict[str, str]:
    """Those of return, task return and success that the task has."""
    found = {c: study.goal_returns(task, "aug", c, "sampled")[1] for c in FIGURES}
    return {c: FIGURES[c] for c, values in found.items() if np.isfinite(values).any()}


@claim("Augmentation yields the highest return.", "Table I", "ppo", "aug")
def _return(study: Study, task: str) -> Judgement:
    texts, outcomes = [], {}
    for column, name in figures(study, task).items():
        text, gap = pair(study, sampled(returns, task, column), "aug", "ppo")
        texts.append(f"{name}: {text}")
        outcomes[column] = verdict(gap)
    losses = weights(study, task)
    if losses:
        best = max(losses, key=lambda m: iqm(sampled(returns, task)(study, m)))
        text, gap = pair(study, sampled(returns, task), "aug", best)
        texts.append(f"return, best weight: {text}")
        outcomes["than mirror loss"] = verdict(gap)
    return "; ".join(texts), joined(**outcomes)


@claim("Augmentation makes the variation between equivalent goals much lower.", "Table I", "ppo", "aug")
def _variation(study: Study, task: str) -> Judgement:
    texts, outcomes = [], {}
    for column, name in figures(study, task).items():
        text, gap = pair(study, sampled(variations, task, column), "ppo", "aug")
        plain, copies = (sampled(variations, task, column)(study, m).mean() for m in ("ppo", "aug"))
        texts.append(f"{name}: {text}, ratio of means {plain / max(copies, 1e-12):.1f}")
        outcomes[column] = verdict(gap)
    return "; ".join(texts), joined(**outcomes)


@claim("Augmentation keeps the symmetry loss low.", "Sec. IV-C", "ppo", "aug")
def _low_loss(study: Study, task: str) -> Judgement:
    plain, copies = (symmetry_loss(study, m, task) for m in ("ppo", "aug"))
    gap = difference(plain, copies)
    text = f"PPO {10 ** iqm(plain):.2g}, PPO + aug. {10 ** iqm(copies):.2g}; orders of magnitude "
    return text + gap.format(1), verdict(gap)


@claim("Augmentation converges fastest.", "Sec. IV-C, Fig. 4", "ppo", "aug")
def _speed(study: Study, task: str) -> Judgement:
    what = partial(steps, task=task)
    text, gap = pair(study, what, "ppo", "aug", 2)
    outcomes = {"than PPO": verdict(gap)}
    losses = weights(study, task)
    if losses:
        fastest = min(losses, key=lambda m: iqm(what(study, m)))
        rival, ahead = pair(study, what, fastest, "aug", 2)
        text += f"; fastest weight: {rival}"
        outcomes["than mirror loss"] = verdict(ahead)
    return f"million steps to the threshold: {text}", joined(**outcomes)


@claim("Without augmentation, the robot turns round to use its favourite limbs.", "Sec. IV-F", "ppo", "aug",
       figure="turning")  # fmt: skip
def _turning(study: Study, task: str) -> Judgement:
    text, gap = pair(study, sampled(returns, task, "turning"), "ppo", "aug", 2)
    return f"yaw travelled in an episode, rad: {text}", verdict(gap)


@claim("Adding a mirror loss to augmentation does not help.", "Sec. IV-C", "aug")
def _both(study: Study, task: str) -> Judgement | None:
    both = with_loss(study, task)
    if both is None:
        return None
    text, gain = pair(study, sampled(returns, task), both, "aug")
    margin = NO_DIFFERENCE * abs(float(iqm(sampled(returns, task)(study, "aug"))))
    return f"return: {text}; margin {margin:.2f}", no_gain(gain, margin)


@claim("One random element per sample is as good as all of them.", "not in the paper", "aug", "aug-random",
       "ppo")  # fmt: skip
def _random(study: Study, task: str) -> Judgement:
    text, loss = pair(study, sampled(returns, task), "aug", "aug-random")
    cost = [seconds_per_step(study, task, m) for m in ("ppo", "aug", "aug-random")]
    margin = NO_DIFFERENCE * abs(float(iqm(sampled(returns, task)(study, "aug"))))
    text += f"; time per step over PPO's: {cost[2] / cost[0]:.2f}, all {cost[1] / cost[0]:.2f}"
    return f"return: {text}; margin {margin:.2f}", no_gain(loss, margin)


def table(study: Study, task: str) -> str:
    """The claims with evidence and verdict, as Markdown."""
    rows = [["claim", "place", "evidence here", "verdict"], ["---"] * 4]
    methods = study.methods(task)
    for each in CLAIMS:
        if not set(each.methods) <= set(methods):
            continue
        if not np.isfinite(study.goal_returns(task, "aug", each.figure, "sampled")[1]).any():
            continue
        judgement = each.judge(study, task)
        if judgement is not None:
            rows.append([each.text, each.place, judgement[0], f"**{judgement[1]}**"])
    return markdown(rows)
