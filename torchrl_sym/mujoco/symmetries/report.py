"""Which symmetries a model has, element by element, and the largest group of them."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.audit import AuditReport


@dataclass(frozen=True)
class Candidate:
    """One element that was tried.

    Attributes:
        name: such as ``"reflect-y"``, ``"reflect-30"`` (the angle of the mirror's normal) or ``"rot-120"``.
        report: the audit of the smallest group that contains it.
        moves: whether it moves anything: the mirror plane of a planar robot does not, and is of no use.
    """

    name: str
    report: AuditReport
    moves: bool

    @property
    def found(self) -> bool:
        """Whether the model has it, exactly or approximately."""
        return self.report.outcome in ("exact", "approximate")


@dataclass(frozen=True)
class SymmetriesReport:
    """What :func:`symmetries` found; ``str()`` gives a table.

    Attributes:
        candidates: the elements that the model has, and of those that people ask for also the others.
        group: the largest group that the model has at least approximately and that moves something with
            every element; the trivial group if there is none.
        exact_group: the largest such group of exact elements.
        audit: of ``group``; of the identity alone it is empty.
        pose: which pose the group keeps, in words.
        axis: where the vertical axis stands, (x, y) in the world.
    """

    candidates: tuple[Candidate, ...]
    group: PointGroup
    exact_group: PointGroup
    audit: AuditReport
    pose: str
    axis: tuple[float, float]

    @property
    def verdict(self) -> str:
        """One line: the group, and how exact it is."""
        if self._still:
            return self.candidates[0].report.verdict
        unclear = [c.name for c in self.candidates if c.report.outcome == "cannot tell"]
        if self.group.order == 1:
            return f"cannot tell ({', '.join(unclear)})" if unclear else "no symmetry"
        elements = ", ".join(self.group.names[1:])
        return f"{elements}: {self.audit.verdict}"

    @property
    def _still(self) -> bool:
        """Whether nothing can move, so that no element says more than another."""
        return bool(self.candidates) and all(c.report.outcome == "nothing" for c in self.candidates)

    def __str__(self) -> str:
        lines = [self.verdict]
        if self._still:
            return lines[0]
        if self.group.order > 1:
            x, y = (round(value, 6) + 0.0 for value in self.axis)
            where = "the origin" if x == y == 0.0 else f"({x:g}, {y:g})"
            lines += [f"pose: {self.pose}; vertical axis through {where}"]
        if 1 < self.exact_group.order < self.group.order:
            lines += [f"exact: {', '.join(self.exact_group.names[1:])}"]
        width = max((len(c.name) for c in self.candidates), default=0)
        lines += [""]
        for candidate in self.candidates:
            note = "" if candidate.moves or not candidate.found else " (moves nothing)"
            lines.append(f"{candidate.name:<{width}s}  {_short(candidate.report)}{note}")
        return "\n".join(lines)


def _short(report: AuditReport) -> str:
    """A verdict without the poses that were tried, which the audit of the element lists."""
    for words in (" at the best of ", " at qpos0;", "; if another pose"):
        head, found, _ = report.verdict.partition(words)
        if found and report.outcome == "no":
            return f"{head})"
    return report.verdict
