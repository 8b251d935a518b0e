"""What a claim is, and the results that it is judged on: one evaluation of one task.

Returns, successes and turning are those of mean actions, in episodes whose starts are paired: between goals
an equivariant policy differs by nothing, another one also by chance. Sampled actions are in the tables.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from comparison.intervals import iqm
from comparison.markdown import markdown
from comparison.methods import Method
from comparison.study import MethodResults, TaskResults
from comparison.verdicts import Figure, joined, pair, verdict

HEAD = ["claim", "place", "evidence here", "verdict"]
FIGURES = {"return": "return", "task_return": "task return", "success": "success"}


@dataclass(frozen=True)
class Evaluated:
    """The methods of a task with one of its evaluations, the first by default."""

    task: TaskResults
    what: str | None = None

    def __getitem__(self, method: str) -> MethodResults:
        return self.task[method]

    def returns(self, column: str = "return") -> Figure:
        """A figure of mean actions, mean over the goals."""
        return lambda results: results.returns(column, what=self.what)

    def variation(self, column: str = "return") -> Figure:
        """The largest difference of a figure of mean actions between two goals."""
        return lambda results: results.variation(column, what=self.what)

    def seeds(self, results: MethodResults, column: str = "return") -> int:
        """How many seeds of a method have a figure."""
        return int(np.isfinite(results.evaluated(column, what=self.what)).all(axis=1).sum())

    @cached_property
    def figures(self) -> dict[str, str]:
        """Return, task return and success, as far as the task has them and they differ."""
        found = {column: name for column, name in FIGURES.items() if self.seeds(self["aug"], column)}
        if self.task.runs["task_return"].equals(self.task.runs["return"]):
            found.pop("task_return", None)
        return found

    def losses(self, least: int = 2) -> list[MethodResults]:
        """The methods with nothing but a mirror loss, and so many seeds."""
        found = [m for m in self.task.values() if m.method.weight]
        return [m for m in found if m.method == Method(weight=m.method.weight) and self.seeds(m) >= least]

    def each(self, a: str, b: str) -> tuple[list[str], dict[str, str]]:
        """Whether a method has more than another, for every figure: texts, and verdicts by name."""
        texts, outcomes = [], {}
        for column, name in self.figures.items():
            text, gap = pair(self.returns(column), self[a], self[b])
            texts.append(f"{name}: {text}" if len(self.figures) > 1 else text)
            outcomes[name] = verdict(gap)
        return texts, outcomes

    def higher(self, a: str, b: str) -> tuple[str, str]:
        """The same as evidence and one verdict."""
        texts, outcomes = self.each(a, b)
        return "; ".join(texts), joined(outcomes)

    @cached_property
    def varied(self) -> bool:
        """Whether several weights of the mirror loss got all seeds, and not those alone that one chose."""
        return len(self.losses()) > 1 and len({self.seeds(m) for m in self.losses(1)}) == 1

    def rivals(self, figure: Figure, best: Callable, called: str) -> list[tuple[str, MethodResults]]:
        """The mirror losses to compare with, each with a prefix: the best of those that were varied, or all
        that one seed chose.
        """
        if not self.varied:
            return [("", loss) for loss in self.losses()]
        return [(f"{called} weight: ", best(self.losses(), key=lambda loss: iqm(figure(loss))))]

    @property
    def left_out(self) -> str:
        """Which mirror losses are not compared, as text that can be appended."""
        names = [m.label for m in self.losses(1) if m not in self.losses()]
        return f"; not compared, of one seed: {', '.join(names)}" if names else ""

    @property
    def with_loss(self) -> MethodResults | None:
        """The method with augmentation and a mirror loss, if there is one."""
        found = [m for m in self.task.values() if m.method.weight]
        found = [m for m in found if m.method == Method("aug", m.method.weight) and self.seeds(m) > 1]
        return next(iter(found), None)


Judge = Callable[[Evaluated], tuple[str, str]]  # evidence, verdict


@dataclass(frozen=True)
class Claim:
    """What the paper says, where, how it is judged here, and what has to be there for it.

    Attributes:
        text: the claim.
        place: where it stands.
        methods: names of the methods that it is about.
        figure: what an evaluation must have; None where training alone is judged.
        needs: what else has to be there.
        judge: gives evidence and verdict.
    """

    text: str
    place: str
    methods: tuple[str, ...]
    figure: str | None
    needs: Callable[[Evaluated], object]
    judge: Judge

    def applies(self, on: Evaluated) -> bool:
        """Whether it can be judged, or could be had seeds of its methods been evaluated."""
        if not (set(self.methods) <= set(on.task) and self.needs(on)):
            return False
        if self.figure is None:
            return on.what in (None, *on.task.evaluations[:1])  # training is the same for all evaluations
        return bool(self.missing(on)) or all(on.seeds(on[name], self.figure) for name in self.methods)

    def missing(self, on: Evaluated) -> list[str]:
        """Methods of which no seed was evaluated."""
        return [on[name].label for name in self.methods if not on.seeds(on[name])]

    def row(self, on: Evaluated) -> list[str]:
        """Claim, place, evidence and verdict."""
        if missing := self.missing(on):
            return [self.text, self.place, f"no seed of {', '.join(missing)} was evaluated", "-"]
        evidence, outcome = self.judge(on)
        return [self.text, self.place, evidence, f"**{outcome}**"]


class Claims(list[Claim]):
    """Claims in the order of a page, each entered where its judge is defined."""

    def claim(
        self,
        text: str,
        place: str,
        *methods: str,
        figure: str | None = "return",
        needs: Callable[[Evaluated], object] = lambda on: True,
    ) -> Callable[[Judge], Judge]:
        """Enter a claim with the judge that is decorated; see `Claim`."""

        def enter(judge: Judge) -> Judge:
            self.append(Claim(text, place, methods, figure, needs, judge))
            return judge

        return enter

    def table(self, task: TaskResults, what: str | None = None) -> str:
        """All claims that apply, with evidence and verdict, as Markdown.

        Args:
            task: results of a task.
            what: one of its evaluations; the first by default.
        """
        on = Evaluated(task, what)
        return markdown(HEAD, [each.row(on) for each in self if each.applies(on)], texts=4)
