"""What later work claims of equivariant networks, and what the paper leaves open, on symmetric tasks.

The rules were written before the runs. Su et al. 2024 is *Leveraging Symmetry in RL-based Legged Locomotion
Control*, MS-PPO Wei et al. 2025 (arXiv 2512.00727), SE-Policy Nie et al. 2025 (arXiv 2508.01247).
"""

from __future__ import annotations

import numpy as np

from comparison.claims import better_and_faster, decades, margins, steps
from comparison.judging import Claims, Evaluated
from comparison.verdicts import joined, more, no_gain, pair, verdict

EXACT = 1e-3  # of the return: a variation below it is none
NETWORKS = ("equivariant", "relaxed")

CLAIMS = Claims()
"""In the order of the page."""
claim, table = CLAIMS.claim, CLAIMS.table


@claim("Equivariant networks reach a higher return than augmentation.", "Su et al. 2024; MS-PPO", "aug",
       "equivariant")  # fmt: skip
def _higher(on: Evaluated) -> tuple[str, str]:
    return on.higher("equivariant", "aug")


@claim("Equivariant networks reach a higher return than plain PPO.", "Su et al. 2024; MS-PPO; SE-Policy",
       "ppo", "equivariant")  # fmt: skip
def _higher_than_plain(on: Evaluated) -> tuple[str, str]:
    return on.higher("equivariant", "ppo")


@claim("They learn from fewer steps than augmentation.", "Su et al. 2024; MS-PPO", "aug", "equivariant",
       figure=None)  # fmt: skip
def _sooner(on: Evaluated) -> tuple[str, str]:
    text, gap = pair(steps, on["aug"], on["equivariant"], 2)
    own, alone = pair(lambda results: results.own_steps, on["aug"], on["equivariant"], 2)
    evidence = (
        f"million steps to a {on.task.measured} of {on.task.threshold:.2f}: {text}; to 90 % of a seed's "
    )
    evidence += f"own last return: {own}"
    return evidence, joined({"to the threshold": verdict(gap), "to own return": verdict(alone)})


@claim("Their equivalent goals differ by nothing.", "by construction", "aug", "equivariant")
def _exact(on: Evaluated) -> tuple[str, str]:
    shares = {name: _share(on, name) for name in ("equivariant", "aug")}
    counts = {name: (int((share < EXACT).sum()), len(share)) for name, share in shares.items()}
    texts = [
        f"{on[name].label} {share.max():.1g} of the return at most, {counts[name][0]} of {counts[name][1]} "
        f"seeds below {EXACT:g}"
        for name, share in shares.items()
    ]
    good, of_all = counts["equivariant"]
    return "; ".join(texts), "confirmed" if good == of_all else "different"


@claim("One can do without the copies: augmentation is no better than an equivariant network.",
       "MS-PPO", "aug", "equivariant")  # fmt: skip
def _no_copies(on: Evaluated) -> tuple[str, str]:
    return _no_better(on, "aug", "equivariant")


@claim("A free part that is kept small costs nothing where the task is symmetric.", "Finzi et al. 2021",
       "equivariant", "relaxed")  # fmt: skip
def _free_part(on: Evaluated) -> tuple[str, str]:
    return _no_better(on, "equivariant", "relaxed")


@claim("Large initial weights hinder augmentation because they are asymmetric.", "asked in Sec. III-B",
       "aug", "aug+init-4", "aug+symmetric-init+init-4")  # fmt: skip
def _asymmetric_weights(on: Evaluated) -> tuple[str, str]:
    plain, large, symmetric = (on[m] for m in ("aug", "aug+init-4", "aug+symmetric-init+init-4"))
    text, helped = pair(on.returns(), symmetric, large)
    rest, missing = pair(on.returns(), plain, symmetric)
    losses = ", ".join(f"{m.label} {m.last_symmetry_loss}" for m in (plain, large, symmetric))
    outcomes = {
        "higher return": verdict(helped),
        "lower symmetry loss": verdict(decades(large, symmetric)),
        "nothing is missing": no_gain(missing, margins(on)[0]),
    }
    return f"return: {text}; {rest}; symmetry loss {losses}", joined(outcomes)


@claim("A symmetric start helps augmentation with weights of ordinary size, too.", "not in the papers",
       "aug", "aug+symmetric-init")  # fmt: skip
def _symmetric_start(on: Evaluated) -> tuple[str, str]:
    return better_and_faster(on, "aug+symmetric-init")


@claim("Equivariant networks fail to learn more often.", "asked here", "aug", "equivariant", figure=None)
def _fail(on: Evaluated) -> tuple[str, str]:
    both = [on[name] for name in ("equivariant", "aug")]
    counts = [(of - reached, of) for reached, of in (results.reached for results in both)]
    each = ", ".join(f"{m.label} {k} of {n}" for m, (k, n) in zip(both, counts, strict=True))
    return f"seeds that never reach {on.task.threshold:.2f}: {each}", more(*counts)


def _no_better(on: Evaluated, a: str, b: str) -> tuple[str, str]:
    """Whether the return of one method is above that of another by less than a margin."""
    text, gain = pair(on.returns(), on[a], on[b])
    margin, _ = margins(on)
    return f"{text}; margin {margin:.3g}", no_gain(gain, margin)


def _share(on: Evaluated, name: str) -> np.ndarray:
    """Variation of the return over its size, of every seed."""
    return on.variation()(on[name]) / np.abs(on.returns()(on[name]))
