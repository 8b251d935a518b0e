"""What was changed to make a model symmetric, and what was left alone."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Change:
    """One quantity of one element: the largest change of an entry, absolute (SI units) and relative."""

    term: str
    name: str
    amount: float
    relative: float


@dataclass
class SymmetrizeReport:
    """What :func:`symmetrize` changed, and what it left alone.

    Attributes:
        changes: every change. Lengths are relative to the model's extent, inertias to their
            trace, angles to a radian, everything else to its own size.
        left: elements that were not averaged, with the reason.
    """

    changes: list[Change] = field(default_factory=list)
    left: list[str] = field(default_factory=list)

    @property
    def largest(self) -> Change | None:
        """The largest relative change, None if nothing changed."""
        return max(self.changes, key=lambda change: change.relative, default=None)

    def __str__(self) -> str:
        rows = [("changed", "elements", "largest", "relative", "at")]
        for term in dict.fromkeys(change.term for change in self.changes):
            of_term = [change for change in self.changes if change.term == term]
            worst = max(of_term, key=lambda change: change.relative)
            rows.append(
                (term, str(len(of_term)), f"{worst.amount:.2g}", f"{worst.relative:.2g}", worst.name)
            )
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(f"{c:<{w}s}" for c, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        head = lines if self.changes else ["nothing changed"]
        return "\n".join([*head, *(f"left alone: {what}" for what in self.left)])
