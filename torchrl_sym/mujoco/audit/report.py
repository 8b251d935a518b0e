"""What an audit says: its verdict and table, what it warns of, and what it does not look at."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Residual:
    """The worst part for one term under one element; ``name`` reads "part -> its image"."""

    element: str
    term: str
    residual: float
    name: str
    kind: str = "dynamics"


@dataclass(frozen=True)
class AuditReport:
    """What :func:`audit` found; ``str()`` gives a table.

    Attributes:
        elements: names of the elements that were tried, without the identity.
        residuals: one row per term and element that the model has.
        tolerance: largest residual that counts as exact.
        reason: why the model lacks the symmetry, None if it has it at least approximately.
        warnings: settings and contacts with which even an exact model is not simulated symmetrically.
        unchecked: what was not compared.
    """

    elements: tuple[str, ...]
    residuals: tuple[Residual, ...]
    tolerance: float
    reason: str | None = None
    warnings: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()

    @property
    def worst(self) -> Residual | None:
        """The row with the largest residual."""
        return max(self.residuals, key=lambda row: row.residual, default=None)

    @property
    def exact(self) -> bool:
        """Whether everything that was compared agrees to the tolerance."""
        return self.reason is None and all(row.residual <= self.tolerance for row in self.residuals)

    @property
    def verdict(self) -> str:
        """One line: exact, approximate or not a symmetry."""
        if self.reason is not None:
            return f"not a symmetry ({self.reason})"
        if self.exact:
            return "exact" if not self.unchecked else "exact in what was checked"
        assert self.worst is not None
        return f"approximate (largest residual {phrase(self.worst)})"

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


def phrase(row: Residual) -> str:
    """A row in words."""
    return f"{row.residual:.2g}: {row.term}, {row.element}, {row.name}"
