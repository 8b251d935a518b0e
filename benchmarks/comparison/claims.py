"""Every claim of the paper that CartPole can decide, judged by a rule on the stored results."""

import itertools
from functools import partial

import numpy as np

from comparison import verdicts
from comparison.intervals import difference, iqm
from comparison.methods import label
from comparison.study import Study
from comparison.tables import markdown, reached, seconds_per_step, steps_to_own, threshold
from comparison.verdicts import Claims, Judgement, counted, joined, more, no_gain, pair, verdict

TASK = "cartpole"
# A goal that is solved by swinging the long way round costs about 2; half of it tells the two ways apart.
SWING = 1.0
NO_DIFFERENCE = {"return": 0.1, "steps": 0.3}  # margins, in return and in million steps
WEIGHTS = ("loss-0.1", "loss-1", "loss-10")

claim = CLAIMS = Claims()

returns, variations, symmetry_loss, steps = (
    partial(what, task=TASK)
    for what in (verdicts.returns, verdicts.variations, verdicts.symmetry_loss, verdicts.steps)
)


def own_steps(study: Study, method: str) -> np.ndarray:
    """Million steps to nine tenths of a seed's own last return."""
    return steps_to_own(study, TASK, method)


def best_weight(study: Study) -> str:
    """The weight of the mirror loss with the highest return."""
    return max(WEIGHTS, key=lambda method: iqm(returns(study, method)))


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
    counts = ", ".join(counted(study, m, task=TASK) for m in ("ppo", "aug"))
    evidence = f"million steps to a training return of {threshold(study, TASK):.2f} ({counts} seeds; those "
    evidence += (
        f"that never do count with all steps): {text}; fastest weight: {rival}; to 90 % of a seed's "
    )
    evidence += f"own last return: {own}"
    outcomes = {"than_PPO": gap, "than_mirror_loss": ahead, "to_own_return": alone}
    return evidence, joined(**{name: verdict(each) for name, each in outcomes.items()})


@claim("Re-evaluating the probabilities of copies makes the training unstable.", "Sec. III-B, Fig. 2")
def _naive(study: Study) -> Judgement:
    low = np.median(study.curve(TASK, "aug-naive", "log_prob_copies")[1].min(axis=1))
    kept = np.median(study.curve(TASK, "aug", "log_prob")[1].min(axis=1))
    good, bad = (reached(study, TASK, method) for method in ("aug", "aug-naive"))
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
    lower = {method: pair(study, returns, "ppo", method) for method in WEIGHTS}
    slower = {method: pair(study, steps, method, "ppo", 2) for method in WEIGHTS}
    weight, heavier = pair(study, steps, WEIGHTS[-1], WEIGHTS[0], 2)
    texts = [", ".join(text for text, _ in each.values()) for each in (lower, slower)]
    outcomes = {f"return of {method}": gap for method, (_, gap) in lower.items()}
    outcomes |= {f"speed of {method}": gap for method, (_, gap) in slower.items()}
    outcomes["weight"] = heavier
    return f"return: {texts[0]}; million steps: {texts[1]}; {weight}", joined(
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
    return markdown([*CLAIMS.HEAD, *(each.row(each.judge(study)) for each in CLAIMS)])
