"""What methods earn under an asymmetry of growing size: trained under it, or met only after training.

A knob is an argument of a task that makes it asymmetric, a dose a value of it. Dose 0 is the task itself.
For every dose two methods are compared by the difference of their interquartile means with its interval.
What is claimed is *confirmed* for a knob if that interval is on the claimed side at the largest dose,
*different* if it is on the other side; *from* names the dose from which on all larger ones say the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from comparison.environments import task_arguments, variant
from comparison.intervals import Estimate, difference, estimate
from comparison.markdown import markdown
from comparison.study import MethodResults, Study, TaskResults
from comparison.verdicts import verdict


@dataclass(frozen=True)
class Dose:
    """An asymmetry of some size.

    Attributes:
        text: the arguments of the task, as its names and evaluations have them.
        knob: what is turned; empty for none.
        size: how far; 1 where it is on or off.
    """

    text: str = ""
    knob: str = ""
    size: float = 0.0

    @classmethod
    def of(cls, text: str) -> Dose:
        """The dose of a task's arguments, of which the first says how much."""
        knob, value = next(iter(task_arguments(text).items()))
        return cls(text, knob, float(value) if isinstance(value, int | float) else 1.0)

    def __str__(self) -> str:
        return f"{self.size:g}"


class Doses:
    """Results of a task without an asymmetry, and with.

    Args:
        without: of the task itself, also evaluated with doses.
        under: a study of its variants, each trained with a dose.
    """

    def __init__(self, without: TaskResults, under: Study) -> None:
        self.without = without
        self.under = under

    @cached_property
    def knobs(self) -> dict[str, list[Dose]]:
        """Doses that were tried in either way, by knob, from small to large."""
        trained = [task.partition("@")[2] for task in self.under if variant(task)[0] == self.without.name]
        met = [what for what in self.without.evaluations if "=" in what]
        known = [Dose.of(text) for text in dict.fromkeys([*trained, *met])]
        knobs = dict.fromkeys(dose.knob for dose in known)
        return {k: sorted((d for d in known if d.knob == k), key=lambda d: d.size) for k in knobs}

    def methods(self, trained: bool) -> list[MethodResults]:
        """Methods that met a dose."""
        return [m for m in self.without.values() if any(self._met(m.name, trained))]

    def returns(self, method: str, dose: Dose, trained: bool) -> np.ndarray:
        """Mean return over the equivalent goals of every seed, ``(seeds,)``; empty if there are none.

        Args:
            method: its name.
            dose: none of which, for the task itself.
            trained: under the dose, or without it.
        """
        if not dose.text:
            return self.without[method].returns()
        if not trained:
            return self.without[method].returns(what=dose.text)
        task = self.under.get(f"{self.without.name}@{dose.text}", {})
        return task[method].returns() if method in task else np.zeros(0)

    def gaps(self, rule: Rule, knob: str) -> dict[Dose, Estimate]:
        """By how much a method is above the other, dose by dose, as far as both have seeds."""
        found = {}
        for dose in [Dose(), *self.knobs[knob]]:
            sides = [self.returns(name, dose, rule.trained) for name in (rule.more, rule.less)]
            if all(map(len, sides)):
                found[dose] = difference(*sides)
        return found

    def _met(self, method: str, trained: bool) -> Iterator[int]:
        for doses in self.knobs.values():
            yield from (len(self.returns(method, dose, trained)) for dose in doses)


@dataclass(frozen=True)
class Rule:
    """A claim on doses: one method earns more than another, trained under the dose or without it."""

    text: str
    place: str
    more: str
    less: str
    trained: bool

    def rows(self, on: Doses) -> list[list[str]]:
        """The claim's rows of a table, one for every knob."""
        rows, head = [], [self.text, self.place]
        for knob in on.knobs:
            gaps = on.gaps(self, knob)
            if not any(dose.text for dose in gaps):
                continue
            texts = [f"{dose}: {gap.format(2)}" for dose, gap in gaps.items()]
            outcome, start = judged(gaps)
            rows.append([*head, knob.replace("_", " "), "; ".join(texts), f"**{outcome}**", start])
            head = ["", ""]
        return rows


RULES = (
    Rule("Augmentation adapts to an asymmetry where an exactly symmetric network cannot.", "Sec. III",
         "aug", "equivariant", True),
    Rule("Exact symmetry costs more than it brings: plain PPO overtakes it.", "Sec. III",
         "ppo", "equivariant", True),
    Rule("A free part that is kept small adapts as well.", "Finzi et al. 2021",
         "relaxed", "equivariant", True),
    Rule("Augmentation pays off though the robot is asymmetric.", "Sec. V", "aug", "ppo", True),
    Rule("Trained without it, policies from augmentation withstand an asymmetry better than plain ones.",
         "Sec. IV-G", "aug", "ppo", False),
    Rule("They withstand it better than exactly symmetric ones.", "Su et al. 2024",
         "aug", "equivariant", False),
)  # fmt: skip
"""Written before the runs, like those of `network_claims.py`."""


def judged(gaps: dict[Dose, Estimate]) -> tuple[str, str]:
    """The verdict at the largest dose, and from which on it is the same ("-": at that dose alone)."""
    outcomes = {dose: verdict(gap) for dose, gap in gaps.items()}
    *smaller, last = outcomes
    first = last
    for dose in reversed(smaller):
        if outcomes[dose] != outcomes[last]:
            break
        first = dose
    return outcomes[last], str(first) if first != last else "-"


def table(on: Doses, rules: Iterable[Rule] = RULES) -> str:
    """All claims, knob by knob, as Markdown."""
    head = ["claim", "place", "knob", "dose: difference of returns", "verdict", "from"]
    return markdown(head, [row for rule in rules for row in rule.rows(on)], texts=6)


def returns_table(on: Doses, trained: bool) -> str:
    """Return of every method at every dose, as Markdown."""
    methods = on.methods(trained)
    rows = []
    for knob, doses in on.knobs.items():
        for dose in doses:
            found = [on.returns(m.name, dose, trained) for m in methods]
            cells = [f"{estimate(x).format(2)} [{len(x)}]" if len(x) else "-" for x in found]
            rows.append([f"{knob.replace('_', ' ')} {dose}", *cells])
    return markdown(["dose", *(m.label for m in methods)], rows)
