"""What generators determine: a value for every element of a group, from those of a few."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

from torchrl_sym.groups import PointGroup

T = TypeVar("T")


def from_generators(
    group: PointGroup, given: Mapping[int, T], identity: T, after: Callable[[T, T], T], what: str
) -> list[T]:
    """The values of all elements, in the group's order.

    A given value is kept even where it contradicts the products of the others, which a check of the whole
    table finds.

    Args:
        group: the group.
        given: values by the indices of elements that generate it.
        identity: that of the identity.
        after: the value of ``g h`` from those of g and h.
        what: what the values are, for the message.

    Raises:
        ValueError: the given elements do not generate the group.
    """
    known, frontier = {0: identity}, [0]
    while frontier:  # walk the group from the identity
        h = frontier.pop()
        for g, value in given.items():
            gh = int(group.table[g, h])
            if gh not in known:
                known[gh] = after(value, known[h])
                frontier.append(gh)

    missing = [name for g, name in enumerate(group.names) if g not in known]
    if missing:
        raise ValueError(
            f"the {what}s for {[group.names[g] for g in given]} do not generate the group: no {what} for "
            f"{missing}; add theirs"
        )
    known |= given
    return [known[g] for g in range(group.order)]
