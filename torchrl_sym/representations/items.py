"""The builder for items that change places, each with a value of its own: agents, tokens, bodies, frames.

A fleet of robots, the fingers of a hand, the bodies that contact forces act on: an element sends the value
of one item, mapped as such values are, to the place of another. On events ``(n, *value)`` this is the
tensor product of how the places change and how a value transforms.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from torchrl_sym import checks
from torchrl_sym.representations.base import MAX_DIM, Representation
from torchrl_sym.representations.blocks import join, product

_TOLERANCE = 1e-9


def items(places: Representation, value: Representation | Sequence[Representation]) -> Representation:
    """Items that change places, each of which transforms by itself.

    =====================================  ================================================
    events                                 written as
    =====================================  ================================================
    external forces on bodies, ``(n, 6)``  ``items(bodies, axial(group) + polar(group))``
    agents or tokens, ``(n, d)``           ``items(agents, one_observation)``
    T frames of a history, ``(T, d)``      ``items(invariant(group, T), frame)``
    clocks of the legs, ``(n, 2)``         ``items(legs, invariant(group, 2))``
    =====================================  ================================================

    Args:
        places: how the items change places, a signed permutation; a sign negates the whole item.
        value: how an item transforms; or a sequence of one for each, in the order of the items. Those of
            items that change places must be equal, and all must have one event shape; items of different
            sizes make no tensor, so build each size by itself and add their ``flatten()``.

    Returns:
        A representation on events of shape ``(*places.event_shape, *value.event_shape)``.

    Raises:
        ValueError: the places mix, representations of different groups, not a value for every item, or
            values that differ where they must not; the message names the items.
        TypeError: no representation.

    Example:
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import permutation, polar
        >>> group = PointGroup.reflection("y")
        >>> hands = permutation(group, ["left", "right"], {"reflect-y": {"left": "right", "right": "left"}})
        >>> forces = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
        >>> items(hands, polar(group))(forces, "reflect-y")
        tensor([[ 4., -5.,  6.],
                [ 1., -2.,  3.]])
    """
    checks.instance("places", places, Representation)
    if not places.is_signed_permutation:
        raise ValueError(
            f"places: expected a signed permutation, got {places}, which mixes items; use "
            "permutation(group, names, maps)"
        )
    values = _check_values(places, value)
    if places.dim * values[0].dim > MAX_DIM:
        raise ValueError(f"expected at most {MAX_DIM} entries, got {places.dim} items of {values[0].dim}")

    block = product(join(places.blocks), [join(each.blocks) for each in values])
    shape = (*places.event_shape, *values[0].event_shape)
    return Representation.from_blocks(places.group, [block], event_shape=shape, check=False)


def _check_values(
    places: Representation, value: Representation | Sequence[Representation]
) -> list[Representation]:
    """One value for all items, or one for each."""
    single = isinstance(value, Representation)
    values = [value] if single else checks.sequence("value", value, of="representations")
    for each in values:
        if checks.instance("value", each, Representation).group != places.group:
            raise ValueError(f"expected a value of the same group, {places.group}, got {each.group}")
    if single:
        return values

    if len(values) != places.dim:
        raise ValueError(f"value: expected one for each of {places.dim} items, got {len(values)}")
    for i, each in enumerate(values):
        if each.event_shape != values[0].event_shape:
            raise ValueError(
                f"value: expected values of one event shape, got {values[0].event_shape} for item 0 and "
                f"{each.event_shape} for item {i}; build the items of each size by themselves and add "
                "their flatten()"
            )
    sources = join(places.blocks).index  # (N, n)
    for g, i in (sources != sources[0]).nonzero().tolist():
        j = int(sources[g, i])
        if not _act_alike(values[i], values[j]):
            raise ValueError(
                f"value: expected equal values of items {i} and {j}, which change places under "
                f"{places.group.names[g]!r}, got {values[i]} and {values[j]}, which act differently"
            )
    return values


def _act_alike(one: Representation, other: Representation) -> bool:
    if one is other:
        return True
    x = torch.randn(one.event_shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return torch.allclose(one.orbit(x), other.orbit(x), rtol=0, atol=_TOLERANCE)
