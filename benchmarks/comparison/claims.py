"""Every claim of the paper that CartPole can decide, judged by a rule on the stored results.

Two methods are compared by the difference of interquartile means over seeds and its 95 % bootstrap
interval: *confirmed* if the interval lies on the claimed side of zero, *different* if it lies on the other
side, *not confirmed* if it contains zero. That something gains nothing is confirmed if the whole interval
is below a margin. Counts of seeds are compared by Fisher's exact test at 5 %.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import stats

from comparison.intervals import Estimate, difference, iqm
from comparison.methods import label
from comparison.study import Study
from comparison.tables import markdown, seconds_per_step, steps_to, steps_to_own, threshold, variation

TASK = "cartpole"
# A goal that is solved by swinging the long way round costs about 2; half of it tells the two ways apart.
SWING = 1.0
NO_DIFFERENCE = {"return": 0.1, "steps": 0.3}  # margins, in return and in million steps
WEIGHTS = ("loss-0.1", "loss-1", "loss-10")

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


def returns(study: Study, method: str, task: str = TASK, **which: str) -> np.ndarray:
    """Evaluated return of every seed, or what else `Study.goal_returns` is asked for."""
    return study.goal_returns(task, method, **which)[1].mean(axis=1)


def variations(study: Study, method: str, task: str = TASK, **which: str) -> np.ndarray:
    """Difference between the goals, of every seed."""
    return variation(study.goal_returns(task, method, **which)[1])


def symmetry_loss(study: Study, method: str, task: str = TASK) -> np.ndarray:
    """Decimal logarithm of the last symmetry loss of every seed."""
    return np.log10(np.maximum(study.curve(task, method, "mirror_loss")[1][:, -1], 1e-12))


def steps(study: Study, method: str, task: str = TASK) -> np.ndarray:
    """Million steps to the threshold; seeds that never reach it count as the whole run."""
    reached = steps_to(study, task, method, threshold(study, task))
    return np.minimum(reached, study.curve(task, method, "return")[0][-1])


def own_steps(study: Study, method: str) -> np.ndarray:
    """Million steps to nine tenths of a seed's own last return."""
    return steps_to_own(study, TASK, method)


def reached(study: Study, method: str, task: str = TASK) -> tuple[int, int]:
    """How many seeds reach the threshold, and how many there are."""
    found = np.isfinite(steps_to(study, task, method, threshold(study, task)))
    return int(found.sum()), len(found)


def best_weight(study: Study) -> str:
    """The weight of the mirror loss with the highest return."""
    return max(WEIGHTS, key=lambda method: iqm(returns(study, method)))


def verdict(claimed_positive: Estimate) -> str:
    """The rule for a difference that the paper says is positive."""
    if claimed_positive.low > 0:
        return "confirmed"
    return "different" if claimed_positive.high < 0 else "not confirmed"


def no_gain(gain: Estimate, margin: float) -> str:
    """The rule for a gain that the paper says is none."""
    if gain.low > 0:
        return "different"
    return "confirmed" if gain.high < margin else "not confirmed"


def more(a: tuple[int, int], b: tuple[int, int]) -> str:
    """The rule for counts, of a total each, of which the paper says the first is larger."""
    table = [[a[0], a[1] - a[0]], [b[0], b[1] - b[0]]]
    if stats.fisher_exact(table, alternative="greater").pvalue < 0.05:
        return "confirmed"
    return "different" if stats.fisher_exact(table, alternative="less").pvalue < 0.05 else "not confirmed"


def pair(study: Study, what: Callable, a: str, b: str, digits: int = 3) -> tuple[str, Estimate]:
    """Both interquartile means, and the difference of the first minus the second, as text and number."""
    x, y = what(study, a), what(study, b)
    gap = difference(x, y)
    values = f"{label(a)} {iqm(x):.{digits}f}, {label(b)} {iqm(y):.{digits}f}"
    return f"{values}, difference {gap.format(digits)}", gap


def joined(**verdicts: str) -> str:
    """One verdict if all agree, or else each with its name."""
    if len(set(verdicts.values())) == 1:
        return next(iter(verdicts.values()))
    return ", ".join(f"{name.replace('_', ' ')}: {outcome}" for name, outcome in verdicts.items())


@claim("Augmentation yields the highest return.", "Sec. IV-C, Fig. 4, Table I")
def _return(study: Study) -> Judgement:
    text, gap = pair(study, returns, "aug", "ppo")
    others, ahead = pair(study, returns, "aug", best_weight(study))
    return f"{text}; best weight: {others}", joined(than_PPO=verdict(gap), than_mirror_loss=verdict(ahead))


@claim("Augmentation makes the variation between equivalent goals much lower.", "Table I: 0.353, 0.003")
def _variation(study: Study) -> Judgement:
    text, gap = pair(study, variations, "ppo", "aug")
    plain, copies = variations(study, "ppo"), variations(study, "aug")
    ratio = f"ratio of means {plain.mean() / copies.mean():.0f}, worst seed of aug. {copies.max():.3f}"
    return f"{text}; {ratio}", verdict(gap)


@claim("Augmentation is the most effective way to a symmetric policy.", "Sec. I-B")
def _most_symmetric(study: Study) -> Judgement:
    best = min(WEIGHTS, key=lambda method: iqm(variations(study, method)))
    text, gap = pair(study, variations, best, "aug")
    return f"variation, most symmetric weight: {text}", verdict(gap)


@claim("Augmentation keeps the symmetry loss low.", "Sec. IV-C, Fig. 4")
def _low_loss(study: Study) -> Judgement:
    gap = difference(symmetry_loss(study, "ppo"), symmetry_loss(study, "aug"))
    values = [10 ** iqm(symmetry_loss(study, m)) for m in ("ppo", "aug")]
    return f"PPO {values[0]:.2g}, PPO + aug. {values[1]:.2g}; orders of magnitude {gap.format(1)}", verdict(
        gap
    )


@claim("Without augmentation, the policy swings up directly from one side only.", "Sec. IV-F")
def _one_sided(study: Study) -> Judgement:
    counts = [
        (int((variations(study, m) > SWING).sum()), len(study.seeds(TASK, m))) for m in ("ppo", "aug")
    ]
    (plain, of_plain), (copies, of_copies) = counts
    text = f"seeds whose sides differ by more than {SWING:g}: PPO {plain} of {of_plain}, aug. {copies} of "
    return f"{text}{of_copies}", more(*counts)


@claim("Augmentation converges fastest.", "Sec. IV-C, Fig. 4")
def _speed(study: Study) -> Judgement:
    fastest = min(WEIGHTS, key=lambda method: iqm(steps(study, method)))
    text, gap = pair(study, steps, "ppo", "aug", 2)
    rival, ahead = pair(study, steps, fastest, "aug", 2)
    own, alone = pair(study, own_steps, "ppo", "aug", 2)
    counts = ", ".join(f"{label(m)} {'{} of {}'.format(*reached(study, m))}" for m in ("ppo", "aug"))
    evidence = (
        f"million steps to a training return of {threshold(study, TASK):.2f} ({counts} seeds): {text}; "
    )
    evidence += f"fastest weight: {rival}; to 90 % of a seed's own last return: {own}"
    outcomes = {"than_PPO": gap, "than_mirror_loss": ahead, "to_own_return": alone}
    return evidence, joined(**{name: verdict(each) for name, each in outcomes.items()})


@claim("Re-evaluating the probabilities of copies makes the training unstable.", "Sec. III-B, Fig. 2")
def _naive(study: Study) -> Judgement:
    low = np.median(study.curve(TASK, "aug-naive", "log_prob_copies")[1].min(axis=1))
    kept = np.median(study.curve(TASK, "aug", "log_prob")[1].min(axis=1))
    good, bad = reached(study, "aug"), reached(study, "aug-naive")
    raw = f"{len(study.diverged(TASK, 'aug-naive-raw'))} of {len(study.seeds(TASK, 'aug-naive-raw'))}"
    text = f"lowest mean log-probability of a run (median of seeds) {low:.0f}, original rule {kept:.1f}; "
    text += f"threshold reached by {bad[0]} of {bad[1]}, original rule {good[0]} of {good[1]}; unprotected "
    return f"{text}{raw} runs end in numbers that are not finite", more(good, bad)


@claim("A larger weight of the mirror loss lowers the symmetry loss.", "Sec. IV-C, Fig. 4")
def _weights(study: Study) -> Judgement:
    levels = ("ppo", *WEIGHTS)
    gaps = [difference(a, b) for a, b in itertools.pairwise(symmetry_loss(study, m) for m in levels)]
    values = ", ".join(f"{label(m)} {10 ** iqm(symmetry_loss(study, m)):.2g}" for m in levels)
    steps_down = {f"from {label(m)}": verdict(gap) for m, gap in zip(levels, gaps, strict=False)}
    return values, joined(**steps_down)


@claim(
    "The mirror loss costs performance and slows learning, more with a larger weight.", "Sec. IV-C, Fig. 4"
)
def _hinders(study: Study) -> Judgement:
    text, gap = pair(study, returns, "ppo", "loss-10")
    slow, slower = pair(study, steps, "loss-10", "ppo", 2)
    weight, heavier = pair(study, steps, "loss-10", "loss-0.1", 2)
    outcomes = {"return": gap, "speed": slower, "weight": heavier}
    return f"return: {text}; million steps: {slow}; {weight}", joined(
        **{name: verdict(each) for name, each in outcomes.items()}
    )


@claim("Adding a mirror loss to augmentation does not help.", "Sec. IV-C, Fig. 4")
def _both(study: Study) -> Judgement:
    text, gain = pair(study, returns, "aug+loss-0.1", "aug")
    faster, saved = pair(study, steps, "aug", "aug+loss-0.1", 2)
    margins = f"margins {NO_DIFFERENCE['return']} and {NO_DIFFERENCE['steps']}"
    outcomes = {"return": no_gain(gain, NO_DIFFERENCE["return"])}
    outcomes["speed"] = no_gain(saved, NO_DIFFERENCE["steps"])
    return f"return: {text}; million steps: {faster}; {margins}", joined(**outcomes)


@claim("Larger initial weights lead to a higher symmetry loss and a lower return.", "Sec. IV-D, Fig. 5")
def _large(study: Study) -> Judgement:
    loss = difference(symmetry_loss(study, "aug+init-4"), symmetry_loss(study, "aug"))
    values = [10 ** iqm(symmetry_loss(study, m)) for m in ("aug+init-4", "aug")]
    text, gap = pair(study, returns, "aug", "aug+init-4")
    evidence = (
        f"symmetry loss {values[0]:.2g} with weights 4 times as large, {values[1]:.2g} without; return: "
    )
    return f"{evidence}{text}", joined(symmetry_loss=verdict(loss), lower_return=verdict(gap))


@claim("Small initial weights are better still.", "Sec. III-B, IV-D (by extension)")
def _small(study: Study) -> Judgement:
    text, gap = pair(study, returns, "aug+init-0.1", "aug")
    speed, faster = pair(study, steps, "aug", "aug+init-0.1", 2)
    return f"return: {text}; million steps: {speed}", joined(
        higher_return=verdict(gap), speed=verdict(faster)
    )


@claim("From large weights, a small mirror loss restores symmetry, not performance.", "Sec. IV-D, Fig. 5")
def _repair(study: Study) -> Judgement:
    repaired, broken = "aug+loss-0.1+init-4", "aug+init-4"
    loss = difference(symmetry_loss(study, broken), symmetry_loss(study, repaired))
    values = [10 ** iqm(symmetry_loss(study, m)) for m in (broken, repaired)]
    text, gap = pair(study, returns, "aug", repaired)
    evidence = f"symmetry loss {values[0]:.2g}, with loss-0.1 {values[1]:.2g}; return: {text}"
    return evidence, joined(symmetry=verdict(loss), return_stays_lower=verdict(gap))


@claim("One random element per sample is as good as all of them.", "not in the paper")
def _random(study: Study) -> Judgement:
    text, loss = pair(study, returns, "aug", "aug-random")
    cost = [seconds_per_step(study, TASK, m) for m in ("ppo", "aug", "aug-random")]
    each = [iqm(variations(study, m)) for m in ("aug-random", "aug")]
    text += f"; variation {each[0]:.3f}, all {each[1]:.3f}; time per step over PPO's: "
    text += f"{cost[2] / cost[0]:.2f}, all {cost[1] / cost[0]:.2f}; margin {NO_DIFFERENCE['return']}"
    return text, no_gain(loss, NO_DIFFERENCE["return"])


def table(study: Study) -> str:
    """All claims with evidence and verdict, as Markdown."""
    rows = [["claim", "place", "evidence here", "verdict"], ["---"] * 4]
    for each in CLAIMS:
        evidence, outcome = each.judge(study)
        rows.append([each.text, each.place, evidence, f"**{outcome}**"])
    return markdown(rows)
