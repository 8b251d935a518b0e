"""What a task observes, stated once: blocks with a name, a value, a unit, a scale and a symmetry.

A table for readers, a representation for the group and a tensor for the policy are three views of one list
of `Entry`. `Observation` is that list with the function that it defines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from tasks.constants import Constant
from tasks.state import State
from torchrl_sym import Representation, checks


@dataclass(frozen=True)
class Entry:
    """A block of the observation: the layout of a task is a tuple of these, in order.

    Attributes:
        name: what it is.
        value: the quantity as a function of a state of n rows, ``(n, dim)``.
        representation: how the group acts on it; its ``dim`` is the block's size.
        unit: of the physical quantity.
        frame: in which frame it is measured.
        kind: how it transforms, in words.
        scale: what the quantity is multiplied by.
        divisor: what it is divided by, where its range is known rather than a factor: x / 3 and x * (1 / 3)
            are rounded differently.

    Raises:
        TypeError: an attribute of another type.
        ValueError: both a scale and a divisor, or no number above zero to divide by.
    """

    name: str
    value: Callable[[State], Tensor]
    representation: Representation
    unit: str
    frame: str
    kind: str
    scale: float = 1.0
    divisor: float = 1.0

    def __post_init__(self) -> None:
        checks.function("value", self.value)
        checks.instance("representation", self.representation, Representation)
        scale = checks.real("scale", self.scale)
        divisor = checks.real("divisor", self.divisor, above=0.0)
        if scale != 1.0 and divisor != 1.0:
            raise ValueError(f"divisor: expected one of scale and divisor, got {scale} and {divisor}")
        for name in ("name", "unit", "frame", "kind"):
            checks.instance(name, getattr(self, name), str)


class Observation:
    """The function from states to observations that a list of entries defines.

    Args:
        entries: the blocks, in order.
        limit: values beyond it are cut off; None for none.

    Attributes:
        representation: how the group acts on the whole.

    Example:
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import pseudoscalar
        >>> angle = pseudoscalar(PointGroup.reflection("x"))
        >>> tilt = Entry(
        ...     "tilt", lambda state: state.qpos, angle, "rad", "world", "changes sign", divisor=2.0
        ... )
        >>> Observation([tilt])(State(torch.ones(1, 1), torch.zeros(1, 1)))
        tensor([[0.5000]])
    """

    def __init__(self, entries: Sequence[Entry], limit: float | None = None) -> None:
        self._entries = [
            checks.instance("entries", entry, Entry)
            for entry in checks.sequence("entries", entries, "Entry")
        ]
        self._limit = None if limit is None else checks.real("limit", limit, above=0.0)
        parts = [entry.representation for entry in self._entries]
        if not parts:
            raise ValueError("entries: expected at least one, got none")
        self.representation: Representation = sum(parts[1:], parts[0])
        self._scale = self._row("scale")
        self._divisor = self._row("divisor")

    def _row(self, name: str) -> Constant | None:
        """What every number is multiplied or divided by, ``(dim,)``; None where that changes nothing."""
        factors = [getattr(entry, name) for entry in self._entries for _ in range(entry.representation.dim)]
        return Constant(factors) if set(factors) != {1.0} else None

    def __call__(self, state: State) -> Tensor:
        """The observation of n rows, a new tensor ``(n, dim)`` float32."""
        observation = torch.cat([entry.value(state) for entry in self._entries], dim=1)
        if self._scale is not None:
            observation.mul_(self._scale.like(observation))
        if self._divisor is not None:
            observation.div_(self._divisor.like(observation))
        observation = observation.float()
        if self._limit is not None:
            observation.clamp_(-self._limit, self._limit)
        return observation

    def check(self, state: State) -> None:
        """ValueError unless every entry's value has the size that its representation has."""
        for entry in self._entries:
            expected, value = (len(state), entry.representation.dim), entry.value(state)
            if not isinstance(value, Tensor) or value.shape != expected:
                raise ValueError(
                    f"observation: expected {entry.name!r} of shape {expected}, as its representation says,"
                    f" got {checks.shown(value)}; correct its value or its representation"
                )
