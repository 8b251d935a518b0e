"""What an audit says: a verdict for each kind of thing, a table, warnings, and what was not looked at.

Dynamics (masses, joints, actuators, ...) and collision shapes decide the headline. What is only observed
(sites of sensors) and the scenery are judged apart: an IMU beside the middle plane changes no motion, and a
robot is symmetric whatever the room it stands in. One discrete mismatch says little of the rest, so
the verdict also says what it would be without it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Kind = Literal["dynamics", "collision", "observation", "scenery"]
Outcome = Literal["exact", "approximate", "no", "cannot tell", "nothing"]

HEADLINE = ("dynamics", "collision")
APART = ("observation", "scenery")

# Beyond it, parts do not correspond. Public robots that are trained as symmetric stay below: 0.07 in the
# hip range of dm_control's humanoid, 0.04 in the inertias of ANYmal-C.
NOT_A_SYMMETRY = 0.1


@dataclass(frozen=True)
class Residual:
    """The worst part for one term under one element.

    Attributes:
        element: name of the group's element.
        term: what was compared.
        residual: how far apart, without a unit.
        name: reads "part -> its image".
        kind: dynamics, collision, observation or scenery.
        amount: how far apart in units, such as "3.2 mm"; empty where a unit says nothing.
    """

    element: str
    term: str
    residual: float
    name: str
    kind: Kind = "dynamics"
    amount: str = ""

    def __str__(self) -> str:
        amount = f" ({self.amount})" if self.amount else ""
        return f"{self.residual:.2g}: {self.term}, {self.element}, {self.name}{amount}"


@dataclass(frozen=True)
class AuditReport:
    """What :func:`audit` found; ``str()`` gives a table.

    Attributes:
        elements: names of the elements that were tried, without the identity.
        residuals: one row per term and element that the model has, of all kinds.
        tolerance: largest residual that counts as exact.
        refusal: why nothing could be compared, None if it could.
        outcome: ``"exact"``, ``"approximate"``, ``"no"``, ``"cannot tell"`` or ``"nothing"`` (to compare).
        warnings: settings and contacts with which even an exact model is not simulated symmetrically.
        unchecked: what was not compared.
        untold: parts, such as actuators, of which it cannot be told where they go.
    """

    elements: tuple[str, ...]
    residuals: tuple[Residual, ...]
    tolerance: float
    refusal: str | None = None
    refused_as: Outcome = "no"
    warnings: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()
    untold: tuple[str, ...] = ()

    @property
    def outcome(self) -> Outcome:
        if self.refusal is not None:
            return self.refused_as
        outcome = self._outcome_of(self.of(*HEADLINE))
        return "cannot tell" if self.untold and outcome != "no" else outcome

    @property
    def reason(self) -> str | None:
        """Why the model lacks the symmetry, or one cannot tell; None if it has it, at least nearly."""
        if self.outcome in ("exact", "approximate"):
            return None
        if self.refusal is not None:
            return self.refusal
        return self.untold[0] if self.outcome == "cannot tell" else str(self.worst)

    @property
    def exact(self) -> bool:
        """Whether everything that decides motion and was compared agrees to the tolerance."""
        return self.outcome == "exact"

    @property
    def worst(self) -> Residual | None:
        """The row with the largest residual of dynamics and collision."""
        return _worst(self.of(*HEADLINE))

    @property
    def verdicts(self) -> dict[str, str]:
        """Verdict of every kind that has rows."""
        kinds = dict.fromkeys(row.kind for row in self.residuals)
        return {kind: self._phrase(self.of(kind)) for kind in kinds}

    @property
    def verdict(self) -> str:
        """One line: exact, approximate, not a symmetry, cannot tell; then what is judged apart."""
        if self.refusal is not None:
            words = {"no": "not a symmetry", "nothing": "nothing to compare"}
            return f"{words.get(self.outcome, self.outcome)} ({self.refusal})"
        text = self._phrase(self.of(*HEADLINE))
        if self.outcome == "cannot tell":
            text = f"cannot tell ({'; '.join(self.untold)}; the rest: {text})"
        elif text == "exact" and self.unchecked:
            text = "exact in what was checked"
        apart = {kind: self._phrase(self.of(kind)) for kind in APART}
        return "; ".join([text, *(f"{kind}: {said}" for kind, said in apart.items() if said != "exact")])

    def of(self, *kinds: str) -> tuple[Residual, ...]:
        """Rows of some kinds."""
        return tuple(row for row in self.residuals if row.kind in kinds)

    def _outcome_of(self, rows: Iterable[Residual]) -> Outcome:
        largest = max((row.residual for row in rows), default=0.0)
        return (
            "exact" if largest <= self.tolerance else "approximate" if largest <= NOT_A_SYMMETRY else "no"
        )

    def _phrase(self, rows: tuple[Residual, ...]) -> str:
        outcome, worst = self._outcome_of(rows), _worst(rows)
        if outcome == "exact" or worst is None:
            return "exact"
        if outcome == "approximate":
            return f"approximate (largest residual {worst})"
        rest = tuple(row for row in rows if row.term != worst.term)
        without = (
            "" if not rest or self._outcome_of(rest) == "no" else f"; without it: {self._phrase(rest)}"
        )
        return f"not a symmetry ({worst}{without})"

    def __str__(self) -> str:
        lines = [self.verdict]
        terms = list(dict.fromkeys(row.term for row in self.residuals))
        cells = {(row.term, row.element): row for row in self.residuals}
        table = [["term", *self.elements, "worst"]]
        for term in terms:
            rows = [cells.get((term, element)) for element in self.elements]
            worst = max((row for row in rows if row), key=lambda row: row.residual)
            shown = worst.name if worst.residual > self.tolerance else ""
            numbers = ["-" if row is None else self._number(row.residual) for row in rows]
            table.append([term, *numbers, shown])
        if terms:
            widths = [max(map(len, column)) for column in zip(*table, strict=True)]
            lines.append("")
            for row in table:
                lines.append("  ".join(f"{c:<{w}s}" for c, w in zip(row, widths, strict=True)).rstrip())
        lines += ["", *(f"warning: {text}" for text in self.warnings)] if self.warnings else []
        lines += ["", *(f"not checked: {text}" for text in self.unchecked)] if self.unchecked else []
        return "\n".join(lines)

    def _number(self, residual: float) -> str:
        return "0" if residual <= self.tolerance else f"{residual:.1e}"


def _worst(rows: Iterable[Residual]) -> Residual | None:
    return max(rows, key=lambda row: row.residual, default=None)
