"""The builder for the phase of a gait.

A gait repeats, and its mirror image is the same gait at another moment: a trot that is mirrored left and
right is itself half a period later. A policy that is told the phase as (sin, cos) must therefore see a
shifted phase in a mirrored state. Where every leg has a clock of its own there is no shift: the clocks
change places with the legs, ``items(legs, invariant(group, 2))``.
"""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction

import torch

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup, check_group
from torchrl_sym.representations.base import Representation
from torchrl_sym.representations.generators import from_generators

_TOLERANCE = 1e-6  # periods


def gait_clock(group: PointGroup, shifts: Mapping[str | int, float]) -> Representation:
    """``(sin, cos)``, in this order, of the phase of one clock for the whole gait.

    Args:
        group: the group that acts.
        shifts: for each element (at least a set of generators), by which part of the period its image of
            the gait is ahead: ``{"reflect-y": 0.5}`` for a trot, a pace or a walk, ``{"rot-120": 1 / 3}``
            for three legs that step in turn, 0 where the image is in phase.

    Raises:
        ValueError: elements that do not generate the group, a shift that does not add up to whole periods
            when its element is repeated, or shifts that contradict the group's product table.

    Example:
        >>> clock = gait_clock(PointGroup.reflection("y"), {"reflect-y": 0.5})
        >>> clock(torch.tensor([0.6, 0.8]), "reflect-y")
        tensor([-0.6000, -0.8000])
    """
    check_group(group)
    given = {}
    for element, shift in checks.mapping("shifts", shifts, "elements to parts of a period").items():
        g = group.index(element)
        given[g] = _fraction(group, g, checks.real(f"shifts[{element!r}]", shift))
    found = from_generators(group, given, Fraction(0), lambda g, h: (g + h) % 1, "shift")
    for g, h in torch.cartesian_prod(*[torch.arange(group.order, device="cpu")] * 2).tolist():
        both = int(group.table[g, h])
        if (found[g] + found[h] - found[both]) % 1:
            one, other, result = (group.names[i] for i in (g, h, both))
            raise ValueError(
                f"shifts contradict one another: expected {found[g]} + {found[h]} for {one!r} after "
                f"{other!r}, which is {result!r}, got {found[both]}"
            )
    # (sin, cos) of a later phase turns clockwise
    turns = [PointGroup.rotation(shift.denominator).matrices[shift.numerator, :2, :2].mT for shift in found]
    return Representation(group, torch.stack(turns))


def _fraction(group: PointGroup, g: int, shift: float) -> Fraction:
    order = group.element_order[g]
    count = round(shift * order)
    if abs(shift * order - count) > _TOLERANCE:
        raise ValueError(
            f"shifts: expected a multiple of 1/{order} for {group.names[g]!r}, which is the identity after "
            f"{order} times, got {shift:g}"
        )
    return Fraction(count, order) % 1
