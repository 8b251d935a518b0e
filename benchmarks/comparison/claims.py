"""Every claim of the paper that CartPole can decide, judged by a rule on the stored results.

Two methods are compared by the difference of interquartile means over seeds and its 95 % bootstrap
interval: *confirmed* if the interval lies on the claimed side of zero, *different* if it lies on the other
side, *not confirmed* if it contains zero. Claims without a comparison state their rule in the evidence.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from comparison.intervals import Estimate, difference, iqm
from comparison.methods import label
from comparison.study import Study
from comparison.tables import seconds_per_step, steps_to, threshold, variation

TASK = "cartpole"
# A goal that is solved by swinging the long way round costs about 2; half of it tells the two ways apart.
SWING = 1.0

Judgement = tuple[str, str]  # evidence, verdict
CLAIMS: list["Claim"] = []


@dataclass(frozen=True)
class Claim:
    """What the paper says, where, and how it is judged here."""

    text: str
    place: str
    judge: Callable[[Study], Judgement]


def claim(text: str, place: str) -> Callable[[Callable[[Study], Judgement]], Callable[[Study], Judgement]]:
    """Register a judge where it is defined."""

    def register(judge: Callable[[Study], Judgement]) -> Callable[[Study], Judgement]:
        CLAIMS.append(Claim(text, place, judge))
        return judge

    return register


def returns(study: Study, method: str) -> np.ndarray:
    """Evaluated return of every seed."""
    return study.goal_returns(TASK, method)[1].mean(axis=1)


def variations(study: Study, method: str) -> np.ndarray:
    """Difference between the goals, of every seed."""
    return variation(study.goal_returns(TASK, method)[1])


def symmetry_loss(study: Study, method: str) -> np.ndarray:
    """Decimal logarithm of the last symmetry loss of every seed."""
    return np.log10(np.maximum(study.curve(TASK, method, "mirror_loss")[1][:, -1], 1e-12))


def steps(study: Study, method: str) -> np.ndarray:
    """Million steps to the threshold; seeds that never reach it count as the whole run."""
    reached = steps_to(study, TASK, method, threshold(study, TASK))
    return np.minimum(reached, study.curve(TASK, method, "return")[0][-1])


def reached(study: Study, method: str) -> str:
    """How many seeds reach the threshold."""
    found = np.isfinite(steps_to(study, TASK, method, threshold(study, TASK)))
    return f"{found.sum()} of {len(found)}"


def verdict(claimed_positive: Estimate) -> str:
    """The rule for a difference that the paper says is positive."""
    if claimed_positive.low > 0:
        return "confirmed"
    return "different" if claimed_positive.high < 0 else "not confirmed"


def no_better(claimed_not_positive: Estimate) -> str:
    """The rule for a difference that the paper says is not positive."""
    return "different" if claimed_not_positive.low > 0 else "confirmed"


def pair(study: Study, what: Callable, a: str, b: str, digits: int = 3) -> tuple[str, Estimate]:
    """Both interquartile means, and the difference of the first minus the second, as text and number."""
    x, y = what(study, a), what(study, b)
    gap = difference(x, y)
    text = (
        f"{label(a)} {iqm(x):.{digits}f}, {label(b)} {iqm(y):.{digits}f}, difference {gap.format(digits)}"
    )
    return text, gap


@claim("Augmentation yields the highest return.", "Sec. IV-C, Table I")
def _return(study: Study) -> Judgement:
    text, gap = pair(study, returns, "aug", "ppo")
    others = [m for m in ("loss-0.1", "loss-1", "loss-10") if m in study.methods(TASK)]
    best = max(others, key=lambda m: iqm(returns(study, m)))
    more, ahead = pair(study, returns, "aug", best)
    outcome = verdict(gap)
    if outcome == "confirmed" and verdict(ahead) != "confirmed":
        outcome = f"confirmed against PPO, {verdict(ahead)} against the mirror loss"
    return f"{text}; best weight: {more}", outcome


@claim("Augmentation makes the variation between equivalent goals much lower.", "Table I: 0.353, 0.003")
def _variation(study: Study) -> Judgement:
    text, gap = pair(study, variations, "ppo", "aug")
    plain, copies = variations(study, "ppo"), variations(study, "aug")
    ratio = f"ratio of means {plain.mean() / copies.mean():.0f}, worst seed of aug. {copies.max():.3f}"
    return f"{text}; {ratio}", verdict(gap)


@claim("Without augmentation, the policy swings up directly from one side only.", "Sec. IV-F")
def _one_sided(study: Study) -> Judgement:
    plain, copies = variations(study, "ppo") > SWING, variations(study, "aug") > SWING
    text = f"variation above {SWING:g}: PPO {plain.sum()} of {len(plain)} seeds, aug. {copies.sum()} of "
    text += f"{len(copies)}; rule: some of PPO, none of aug."
    return text, "confirmed" if plain.any() and not copies.any() else "not confirmed"


@claim("Augmentation converges fastest.", "Sec. IV-C")
def _speed(study: Study) -> Judgement:
    text, gap = pair(study, steps, "ppo", "aug", 2)
    goal = threshold(study, TASK)
    counts = f"reached by PPO {reached(study, 'ppo')}, aug. {reached(study, 'aug')}"
    return f"million steps to a training return of {goal:.2f}: {text}; {counts}", verdict(gap)


@claim("Re-evaluating the probabilities of copies makes the training unstable.", "Sec. III-B, Fig. 2")
def _naive(study: Study) -> Judgement:
    low = np.median(study.curve(TASK, "aug-naive", "log_prob_copies")[1].min(axis=1))
    kept = np.median(study.curve(TASK, "aug", "log_prob")[1].min(axis=1))
    text = f"lowest mean log-probability of a run (median of seeds): {low:.0f}, original rule {kept:.1f}; "
    text += f"threshold reached by {reached(study, 'aug-naive')}, original rule {reached(study, 'aug')}; "
    seeds = len(study.seeds(TASK, "aug-naive-raw"))
    text += (
        f"without bounds {study.diverged(TASK, 'aug-naive-raw')} of {seeds} end in numbers that are not "
    )
    text += "finite; rule: fewer seeds reach the threshold"
    goal = threshold(study, TASK)
    share = [np.isfinite(steps_to(study, TASK, m, goal)).mean() for m in ("aug", "aug-naive")]
    return text, "confirmed" if share[1] < share[0] else "not confirmed"


@claim("A larger weight of the mirror loss lowers the symmetry loss.", "Sec. IV-C")
def _weights(study: Study) -> Judgement:
    levels = ["ppo", "loss-0.1", "loss-1", "loss-10"]
    gaps = [difference(a, b) for a, b in itertools.pairwise(symmetry_loss(study, m) for m in levels)]
    values = ", ".join(f"{label(m)} {10 ** iqm(symmetry_loss(study, m)):.2g}" for m in levels)
    decided = [verdict(gap) for gap in gaps]
    outcome = "confirmed" if set(decided) == {"confirmed"} else "not confirmed"
    return f"{values}; rule: every step down", outcome


@claim("The mirror loss costs performance, more with a larger weight.", "Sec. IV-C")
def _hinders(study: Study) -> Judgement:
    text, gap = pair(study, returns, "ppo", "loss-10")
    more, slower = pair(study, steps, "loss-10", "loss-0.1", 2)
    outcomes = (verdict(gap), verdict(slower))
    words = outcomes[0] if outcomes[0] == outcomes[1] else f"return: {outcomes[0]}, speed: {outcomes[1]}"
    return f"return: {text}; million steps: {more}", words


@claim("Adding a mirror loss to augmentation does not help.", "Sec. IV-C")
def _both(study: Study) -> Judgement:
    text, gap = pair(study, returns, "aug+loss-0.1", "aug")
    more, faster = pair(study, steps, "aug", "aug+loss-0.1", 2)
    outcomes = (no_better(gap), no_better(faster))
    words = outcomes[0] if outcomes[0] == outcomes[1] else f"return: {outcomes[0]}, speed: {outcomes[1]}"
    return f"return: {text}; million steps: {more}", words


@claim("Larger initial weights lead to a higher symmetry loss and a lower return.", "Sec. IV-D, Fig. 6")
def _large(study: Study) -> Judgement:
    loss = difference(symmetry_loss(study, "aug+init-4"), symmetry_loss(study, "aug"))
    values = [10 ** iqm(symmetry_loss(study, m)) for m in ("aug+init-4", "aug")]
    text, gap = pair(study, returns, "aug", "aug+init-4")
    text = (
        f"symmetry loss with weights 4 times as large {values[0]:.2g}, else {values[1]:.2g}; return: {text}"
    )
    return text, f"symmetry loss: {verdict(loss)}, return: {verdict(gap)}"


@claim("Small initial weights are better still.", "Sec. IV-D (by extension)")
def _small(study: Study) -> Judgement:
    text, gap = pair(study, returns, "aug+init-0.1", "aug")
    more, faster = pair(study, steps, "aug", "aug+init-0.1", 2)
    return f"return: {text}; million steps: {more}", f"return: {verdict(gap)}, speed: {verdict(faster)}"


@claim(
    "From large weights, a small mirror loss restores symmetry but not performance.", "Sec. IV-D, Fig. 6"
)
def _repair(study: Study) -> Judgement:
    repaired, broken = "aug+loss-0.1+init-4", "aug+init-4"
    loss = difference(symmetry_loss(study, broken), symmetry_loss(study, repaired))
    values = [10 ** iqm(symmetry_loss(study, m)) for m in (broken, repaired)]
    text, gap = pair(study, returns, "aug", repaired)
    text = f"symmetry loss {values[0]:.2g}, with loss-0.1 {values[1]:.2g}; return: {text}"
    return text, f"symmetry: {verdict(loss)}, return stays lower: {verdict(gap)}"


@claim("One random element per sample instead of all costs nothing.", "not in the paper")
def _random(study: Study) -> Judgement:
    text, gap = pair(study, returns, "aug", "aug-random")
    cost = [seconds_per_step(study, TASK, m) for m in ("ppo", "aug", "aug-random")]
    text += f"; time per step over PPO's: all {cost[1] / cost[0]:.2f}, random {cost[2] / cost[0]:.2f}"
    text += (
        f"; variation {iqm(variations(study, 'aug-random')):.3f}, all {iqm(variations(study, 'aug')):.3f}"
    )
    return text, no_better(gap)


def table(study: Study) -> str:
    """All claims with evidence and verdict, as Markdown."""
    lines = ["| claim | place | evidence here | verdict |", "| --- | --- | --- | --- |"]
    for each in CLAIMS:
        evidence, outcome = each.judge(study)
        lines.append(f"| {each.text} | {each.place} | {evidence} | **{outcome}** |")
    return "\n".join(lines) + "\n"
