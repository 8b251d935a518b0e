"""Every claim of the paper, judged by a rule on the stored results of a task that can decide it.

One list for all tasks: a claim says which methods and figures it needs, and applies where they are.
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from comparison.intervals import difference, iqm
from comparison.judging import Claims, Evaluated
from comparison.study import MethodResults
from comparison.verdicts import joined, more, no_gain, pair, verdict

# A goal of CartPole that is solved by swinging the long way round costs about 2; half of it tells the two
# ways apart.
SWING = 1.0
# What counts as no difference: in return and in million steps; in return, for tasks that are not here, as a
# share of that of augmentation.
MARGINS = {"cartpole": (0.1, 0.3)}
SHARE_OF_RETURN = 0.05
# The paper's variation without and with augmentation, of the task that it shares in numbers (Table I).
REPORTED = {"cartpole": "0.353 and 0.003"}

CLAIMS = Claims()
"""In the order of the pages."""
claim, table = CLAIMS.claim, CLAIMS.table


@claim("Augmentation yields the highest return.", "Sec. IV-C, Fig. 4, Table I", "ppo", "aug")
def _return(on: Evaluated) -> tuple[str, str]:
    texts, outcomes = on.each("aug", "ppo")
    for prefix, loss in on.rivals(on.returns(), max, "best"):
        text, gap = pair(on.returns(), on["aug"], loss)
        texts.append(f"{prefix or 'return: '}{text}")
        outcomes[f"than {loss.name}"] = verdict(gap)
    return "; ".join(texts) + on.left_out, joined(outcomes)


@claim("Augmentation makes the variation between equivalent goals much lower.", "Table I", "ppo", "aug")
def _variation(on: Evaluated) -> tuple[str, str]:
    texts, outcomes = [], {}
    for column, name in on.figures.items():
        text, gap = pair(on.variation(column), on["ppo"], on["aug"])
        plain, copies = (on.variation(column)(on[method]) for method in ("ppo", "aug"))
        text += f", ratio of means {plain.mean() / max(copies.mean(), 1e-12):.1f}"
        if column == "success":
            chance = on["ppo"].chance_variation(on.what)
            certain = difference(plain - chance, copies)
            text += f"; without what chance explains of PPO's, {chance.mean():.3f} at most: "
            text += certain.format()
            gap = dataclasses.replace(gap, low=certain.low)  # an upper bound confirms, it does not refute
        texts.append(f"{name}: {text}" if len(on.figures) > 1 else text)
        outcomes[name] = verdict(gap)
    if on.task.name in REPORTED:
        texts.append(f"in the paper {REPORTED[on.task.name]}")
    return "; ".join(texts), joined(outcomes)


@claim("Augmentation is the most effective way to a symmetric policy.", "Sec. I-B", "aug",
       needs=lambda on: on.varied)  # fmt: skip
def _most_symmetric(on: Evaluated) -> tuple[str, str]:
    ((prefix, best),) = on.rivals(on.variation(), min, "most symmetric")
    text, gap = pair(on.variation(), best, on["aug"])
    return f"variation, {prefix}{text}", verdict(gap)


@claim("Augmentation keeps the symmetry loss low.", "Sec. IV-C, Fig. 4", "ppo", "aug", figure=None)
def _low_loss(on: Evaluated) -> tuple[str, str]:
    gap = decades(on["ppo"], on["aug"])
    losses = ", ".join(f"{m.label} {m.last_symmetry_loss}" for m in (on["ppo"], on["aug"]))
    return f"{losses}; orders of magnitude {gap.format(1)}", verdict(gap)


@claim("Without augmentation, the policy swings up directly from one side only.", "Sec. IV-F", "ppo", "aug",
       needs=lambda on: on.task.name == "cartpole")  # fmt: skip
def _one_sided(on: Evaluated) -> tuple[str, str]:
    counts = [(int((m.variation() > SWING).sum()), len(m.seeds)) for m in (on["ppo"], on["aug"])]
    (plain, of_plain), (copies, of_copies) = counts
    text = f"seeds whose sides differ by more than {SWING:g}: PPO {plain} of {of_plain}, aug. {copies} of "
    return f"{text}{of_copies}", more(*counts)


@claim("Augmentation converges fastest.", "Sec. IV-C, Fig. 4", "ppo", "aug", figure=None)
def _speed(on: Evaluated) -> tuple[str, str]:
    texts, outcomes = [], {}
    for prefix, slower in [("", on["ppo"]), *on.rivals(steps, min, "fastest")]:
        text, gap = pair(steps, slower, on["aug"], 2)
        texts.append(f"{prefix}{text}")
        outcomes[f"than {slower.name}"] = verdict(gap)
    everything = "the whole curriculum"
    if not on.task.has_curriculum:
        own, alone = pair(lambda m: m.own_steps, on["ppo"], on["aug"], 2)
        texts.append(f"to 90 % of a seed's own last return: {own}")
        outcomes["to own return"] = verdict(alone)
        everything = "all steps"
    counts = ", ".join("{} {} of {}".format(on[m].label, *on[m].reached) for m in ("ppo", "aug"))
    evidence = f"million steps to a {on.task.measured} of {on.task.threshold:.2f} ({counts} seeds; those "
    evidence += f"that never do count with {everything}): {'; '.join(texts)}{on.left_out}"
    return evidence, joined(outcomes)


@claim("When starts get any heading, augmentation recovers sooner.", "Sec. IV-C, Fig. 4", "ppo", "aug",
       figure=None, needs=lambda on: on.task.has_phases)  # fmt: skip
def _recovery(on: Evaluated) -> tuple[str, str]:
    every = {on[name]: on[name].recoveries for name in ("ppo", "aug")}
    entered = {m: taken[np.isfinite(taken)] for m, taken in every.items()}
    counts = ", ".join(f"{m.label} {len(entered[m])} of {len(every[m])}" for m in every)
    if not all(len(taken) for taken in entered.values()):
        return f"seeds that enter phase C: {counts}", "undecided"
    text, gap = pair(lambda m: entered[m], on["ppo"], on["aug"], 2)
    evidence = f"million steps from the start of phase C ({counts} seeds enter it) to nine tenths of what "
    return f"{evidence}is regained: {text}", verdict(gap)


@claim("Without augmentation, the robot turns round to use its favourite limbs.", "Sec. IV-F", "ppo", "aug",
       figure="turning")  # fmt: skip
def _turning(on: Evaluated) -> tuple[str, str]:
    text, gap = pair(on.returns("turning"), on["ppo"], on["aug"], 2)
    return f"yaw travelled in an episode, to and fro, gait included, rad: {text}", verdict(gap)


@claim("Re-evaluating the probabilities of copies makes the training unstable.", "Sec. III-B, Fig. 2",
       "aug", "aug-naive", figure=None, needs=lambda on: "aug-naive-raw" in on.task)  # fmt: skip
def _naive(on: Evaluated) -> tuple[str, str]:
    low = np.median(on["aug-naive"].curve("log_prob_copies").min())
    kept = np.median(on["aug"].curve("log_prob").min())
    good, bad = on["aug"].reached, on["aug-naive"].reached
    raw = f"{len(on['aug-naive-raw'].diverged)} of {len(on['aug-naive-raw'].seeds)}"
    text = f"lowest mean log-probability of a run (median of seeds) {low:.0f}, original rule {kept:.1f}; "
    text += f"threshold reached by {bad[0]} of {bad[1]}, original rule {good[0]} of {good[1]}; unprotected "
    return f"{text}{raw} runs end in numbers that are not finite", more(good, bad)


@claim("A larger weight of the mirror loss lowers the symmetry loss.", "Sec. IV-C, Fig. 4", "ppo",
       figure=None, needs=lambda on: on.varied)  # fmt: skip
def _weights(on: Evaluated) -> tuple[str, str]:
    levels = [on["ppo"], *_by_weight(on)]
    values = ", ".join(f"{m.label} {m.last_symmetry_loss}" for m in levels)
    return values, joined(
        {f"from {a.label}": verdict(decades(a, b)) for a, b in itertools.pairwise(levels)}
    )


@claim("The mirror loss costs performance and slows learning, more with a larger weight.",
       "Sec. IV-C, Fig. 4", "ppo", needs=lambda on: on.varied)  # fmt: skip
def _hinders(on: Evaluated) -> tuple[str, str]:
    losses = _by_weight(on)
    lower = {f"return of {m.name}": pair(on.returns(), on["ppo"], m) for m in losses}
    slower = {f"speed of {m.name}": pair(steps, m, on["ppo"], 2) for m in losses}
    heavier, gap = pair(steps, losses[-1], losses[0], 2)
    returns, speeds = (", ".join(text for text, _ in each.values()) for each in (lower, slower))
    outcomes = {name: verdict(each) for name, (_, each) in (lower | slower).items()}
    evidence = f"return: {returns}; million steps: {speeds}; {heavier}"
    return evidence, joined(outcomes | {"weight": verdict(gap)})


@claim("Adding a mirror loss to augmentation does not help.", "Sec. IV-C, Fig. 4", "aug",
       needs=lambda on: on.with_loss)  # fmt: skip
def _both(on: Evaluated) -> tuple[str, str]:
    both, (in_return, in_steps) = on.with_loss, margins(on)
    text, gain = pair(on.returns(), both, on["aug"])
    outcomes = {"return": no_gain(gain, in_return)}
    if in_steps is None:
        return f"return: {text}; margin {in_return:.3g}", joined(outcomes)
    faster, saved = pair(steps, on["aug"], both, 2)
    outcomes["speed"] = no_gain(saved, in_steps)
    return f"return: {text}; million steps: {faster}; margins {in_return} and {in_steps}", joined(outcomes)


@claim("Larger initial weights lead to a higher symmetry loss and a lower return.", "Sec. IV-D, Fig. 5",
       "aug", "aug+init-4")  # fmt: skip
def _large(on: Evaluated) -> tuple[str, str]:
    large, small = on["aug+init-4"], on["aug"]
    text, gap = pair(on.returns(), small, large)
    evidence = f"symmetry loss {large.last_symmetry_loss} with weights 4 times as large, "
    outcomes = {"symmetry loss": verdict(decades(large, small)), "lower return": verdict(gap)}
    return f"{evidence}{small.last_symmetry_loss} without; return: {text}", joined(outcomes)


@claim("Small initial weights are better still.", "Sec. III-B, IV-D (by extension)", "aug", "aug+init-0.1")
def _small(on: Evaluated) -> tuple[str, str]:
    return better_and_faster(on, "aug+init-0.1")


@claim("From large weights, a small mirror loss restores symmetry, not performance.", "Sec. IV-D, Fig. 5",
       "aug", "aug+init-4", "aug+loss-0.1+init-4")  # fmt: skip
def _repair(on: Evaluated) -> tuple[str, str]:
    broken, repaired = on["aug+init-4"], on["aug+loss-0.1+init-4"]
    text, gap = pair(on.returns(), on["aug"], repaired)
    evidence = f"symmetry loss {broken.last_symmetry_loss}, with loss-0.1 {repaired.last_symmetry_loss}; "
    outcomes = {"symmetry": verdict(decades(broken, repaired)), "return stays lower": verdict(gap)}
    return f"{evidence}return: {text}", joined(outcomes)


@claim("One random element per sample is as good as all of them.", "not in the paper", "aug", "aug-random",
       "ppo")  # fmt: skip
def _random(on: Evaluated) -> tuple[str, str]:
    text, loss = pair(on.returns(), on["aug"], on["aug-random"])
    plain, every, one = (on[name] for name in ("ppo", "aug", "aug-random"))
    variations = [iqm(on.variation()(m)) for m in (one, every)]
    costs = [m.seconds_per_step / plain.seconds_per_step for m in (one, every)]
    margin, _ = margins(on)
    text = f"return: {text}; variation {variations[0]:.3f}, all {variations[1]:.3f}; time per step over "
    text += f"PPO's: {costs[0]:.2f}, all {costs[1]:.2f}; margin {margin:.3g}"
    return text, no_gain(loss, margin)


def better_and_faster(on: Evaluated, name: str) -> tuple[str, str]:
    """Whether a method has a higher return than augmentation, and learns from fewer steps."""
    text, gap = pair(on.returns(), on[name], on["aug"])
    speed, faster = pair(steps, on["aug"], on[name], 2)
    outcomes = {"higher return": verdict(gap), "speed": verdict(faster)}
    return f"return: {text}; million steps: {speed}", joined(outcomes)


def steps(results: MethodResults) -> np.ndarray:
    return results.steps


def decades(a: MethodResults, b: MethodResults):
    """By how many orders of magnitude the symmetry loss of one method is above that of another."""
    return difference(a.symmetry_loss, b.symmetry_loss)


def _by_weight(on: Evaluated) -> list[MethodResults]:
    return sorted(on.losses(), key=lambda results: results.method.weight)


def margins(on: Evaluated) -> tuple[float, float | None]:
    """Differences that count as none: in return, and in million steps where that is said."""
    share = SHARE_OF_RETURN * abs(float(iqm(on.returns()(on["aug"]))))
    return MARGINS.get(on.task.name, (share, None))
