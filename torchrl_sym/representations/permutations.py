"""Builders for named entries: joints, actuators, feet, agents.

Joint orders differ between simulators and even between releases of one robot's model, so permutations
are written with names, never with positions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup, check_group
from torchrl_sym.representations.base import Representation
from torchrl_sym.representations.blocks import SignedPermutation
from torchrl_sym.representations.generators import from_generators


def signed_permutation(
    group: PointGroup, names: Sequence[str], maps: Mapping[str, Mapping[str, str]]
) -> Representation:
    """Named entries that change places and signs: joints, actuators.

    Args:
        group: the group that acts.
        names: the entries in the order of the tensor, ``d`` of them.
        maps: for each element (at least a set of generators), where each entry goes:
            ``{"reflect-y": {"left_hip": "-right_hip", ...}}`` reads "the left hip's value becomes the
            negative of the right hip's". Products of the given elements are filled in.

    Raises:
        ValueError: an unknown or missing entry, two entries sent to one place, elements that do not
            generate the group, or maps that contradict the group's product table.

    Example:
        >>> group = PointGroup.reflection("y")
        >>> swap = {"left": "-right", "right": "-left", "knee": "knee"}
        >>> hips = signed_permutation(group, ["left", "right", "knee"], {"reflect-y": swap})
        >>> hips(torch.tensor([1.0, 2.0, 3.0]), "reflect-y")
        tensor([-2., -1.,  3.])
    """
    check_group(group)
    names = checks.names("names", names)
    given = {group.index(g): _parse(g, names, targets) for g, targets in _check_maps(maps).items()}
    stay = torch.arange(len(names), device="cpu"), torch.ones(len(names), dtype=torch.int8, device="cpu")
    found = from_generators(group, given, stay, _after, "map")
    index, sign = (torch.stack(parts) for parts in zip(*found, strict=True))
    return Representation.from_blocks(group, [SignedPermutation(index, sign)])


def _after(g: tuple[Tensor, Tensor], h: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """First h, then g, each as source positions and signs."""
    return h[0][g[0]], g[1] * h[1][g[0]]


def permutation(
    group: PointGroup, names: Sequence[str], maps: Mapping[str, Mapping[str, str]]
) -> Representation:
    """Named entries that change places and keep their signs: contact flags, gains, foot heights.

    Same arguments as :func:`signed_permutation`; a minus sign in a target is an error.
    """
    for element, targets in _check_maps(maps).items():
        for source, target in targets.items():
            if target.startswith("-"):
                raise ValueError(
                    f"{element!r} sends {source!r} to {target!r}: expected no sign; use signed_permutation"
                )
    return signed_permutation(group, names, maps)


def _check_maps(maps: Mapping[str, Mapping[str, str]]) -> Mapping[str, Mapping[str, str]]:
    for element, targets in checks.mapping("maps", maps, "elements to maps of names").items():
        for source, target in checks.mapping(f"maps[{element!r}]", targets, "names to names").items():
            checks.instance(f"maps[{element!r}][{source!r}]", target, str, "write a name, or -name")
    return maps


def _parse(element: str, names: list[str], targets: Mapping[str, str]) -> tuple[Tensor, Tensor]:
    index = torch.full((len(names),), -1, device="cpu")
    sign = torch.ones(len(names), dtype=torch.int8, device="cpu")
    for source, target in targets.items():
        goal = target.removeprefix("-")
        for name in (source, goal):
            if name not in names:
                raise ValueError(f"{element!r} maps the unknown entry {name!r}; there are {names}")
        if index[names.index(goal)] >= 0:
            raise ValueError(
                f"{element!r} is not a permutation: two entries are sent to {goal!r}, one is {source!r}; "
                "send every entry to a place of its own"
            )
        index[names.index(goal)] = names.index(source)
        sign[names.index(goal)] = -1 if target.startswith("-") else 1
    absent = [name for name in names if name not in targets]
    if absent:
        raise ValueError(
            f"{element!r} does not say where {absent} go; list entries that stay as themselves"
        )
    return index, sign
