"""What a verification says: symmetric, not symmetric and where, or not tested.

The identity is one of the elements. It maps a state onto itself, so if its rows fail, the same state had
two futures: something outside the state decides, and no other row says anything of the symmetry.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torchrl_sym import checks

# In the order of cause: a wrong part makes those after it wrong as well. States come before observations,
# which may contain forces, and on which no state depends.
PARTS = (
    *("action box", "dynamics", "contact", "kinematics", "reward", "termination"),
    *("next observation", "rollout", "reset"),
)


@dataclass(frozen=True)
class VerifyRow:
    """One residual: of which part and element, how large, and in which entry or joint it is worst.

    Residuals are relative to the largest value of their entry, or 1 if that is smaller. Those of
    ``"reset"`` are Kolmogorov-Smirnov distances; that of ``"termination"`` is a fraction of states.
    """

    part: str
    element: str
    value: float
    limit: float
    where: str

    @property
    def passed(self) -> bool:
        return self.value <= self.limit

    @property
    def excess(self) -> float:
        """Value over limit."""
        if self.limit > 0:
            return self.value / self.limit
        return math.inf if self.value > 0 else 0.0

    def __str__(self) -> str:
        verdict = "reported" if math.isinf(self.limit) else "ok" if self.passed else "FAILED"
        limit = "" if math.isinf(self.limit) else f"{self.limit:.1e}"
        size = f"{self.value:9.2e} {limit:>9s}"
        return f"{self.part:<17s} {self.element:<12s} {size}  {verdict:<8s}  {self.where}"


@dataclass
class VerifyReport:
    """What :func:`~torchrl_sym.mujoco.verify` measured; ``str()`` makes it a table.

    Attributes:
        rows: all residuals, by part.
        states: number of states tested.
        contacts: how many of them were in contact. With none, contact was not tested.
        identity: name of the identity, whose rows the table leaves out while they pass.
        untested: what was not tested at all, in words: contact that was never reached, actions without
            effect, elements that change nothing.
    """

    rows: list[VerifyRow]
    states: int
    contacts: int
    identity: str = "identity"
    untested: Sequence[str] = ()

    @property
    def passed(self) -> bool:
        """Whether every row passes, and nothing is untested."""
        return not self.untested and all(row.passed for row in self.rows)

    @property
    def deterministic(self) -> bool:
        """Whether one state has one future: the identity passes. If not, no other row says anything."""
        return all(row.passed for row in self.rows if row.element == self.identity)

    @property
    def tested(self) -> bool:
        """Whether the rows say something of the symmetry: one state has one future, nothing is untested."""
        return self.deterministic and not self.untested

    @property
    def verdict(self) -> str:
        """One sentence: symmetric, not symmetric, or not tested."""
        if self.passed:
            return "symmetric"
        if self.deterministic and not all(row.passed for row in self.rows):
            return f"not symmetric, first in {self.worst.part}"
        if self.deterministic:
            return f"not tested: {'; '.join(self.untested)}"
        return (
            "not tested: the environment remembers something that its state does not hold, or draws noise, "
            f"so that nothing below says anything of the symmetry (first in {self.worst.part}, "
            f"{self.worst.where}); hand it over with verify(..., memory=...), or switch the noise off"
        )

    @property
    def worst(self) -> VerifyRow:
        """The largest failure of the first part that fails; the row nearest its limit if none does.

        Failures of the identity come before all others.
        """
        failed = [row for row in self.rows if not row.passed]
        failed = [row for row in failed if row.element == self.identity] or failed
        first = [row for row in failed if row.part == failed[0].part]
        return max(first or self.rows, key=lambda row: row.excess)

    def of(self, part: str) -> list[VerifyRow]:
        """Rows of one part."""
        checks.one_of("part", part, PARTS, KeyError)
        return [row for row in self.rows if row.part == part]

    def __str__(self) -> str:
        shown = [row for row in self.rows if row.element != self.identity or not row.passed]
        header = f"{'part':<17s} {'element':<12s} {'residual':>9s} {'limit':>9s}  {'':<8s}  worst at"
        count = f"{self.states} states, {self.contacts} in contact"
        count += "".join(f"\nnot tested: {what}" for what in self.untested)
        title = f"{self.verdict}: {count}" if self.deterministic else f"{self.verdict}\n\n{count}"
        return "\n".join([title, "", header, *map(str, shown)])
