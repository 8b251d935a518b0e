"""Builders for named entries and sampled fields: joints, actuators, feet, height maps.

Joint orders differ between simulators and even between releases of one robot's model, so permutations
are written with names, never with positions. Fields sampled at points (height maps, range finders) need
no table at all: the group moves the sample points, and the builder finds where each one lands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup, check_group
from torchrl_sym.representations.base import Representation
from torchrl_sym.representations.blocks import SignedPermutation
from torchrl_sym.representations.vectors import _horizontal


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
    known = {0: (torch.arange(len(names), device="cpu"), torch.ones(len(names), dtype=torch.int8))}
    given = {group.index(g): _parse(g, names, targets) for g, targets in _check_maps(maps).items()}
    frontier = [0]
    while frontier:  # walk the group from the identity by the given elements
        h = frontier.pop()
        for g, (index, sign) in given.items():
            gh = int(group.table[g, h])
            if gh not in known:
                known[gh] = known[h][0][index], sign * known[h][1][index]
                frontier.append(gh)
    missing = [group.names[g] for g in range(group.order) if g not in known]
    if missing:
        raise ValueError(
            f"the maps for {list(maps)} do not generate the group: no map for {missing}; add theirs"
        )
    known |= given  # a map that contradicts the products of the others is found by the check below
    index = torch.stack([known[g][0] for g in range(group.order)])
    sign = torch.stack([known[g][1] for g in range(group.order)])
    return Representation.from_blocks(group, [SignedPermutation(index, sign)])


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


def points(
    group: PointGroup,
    positions: Tensor | Sequence[Sequence[float]],
    value: Representation | None = None,
    *,
    tolerance: float = 1e-6,
) -> Representation:
    """A field sampled at P points that move with the robot: height maps, range finders, foot forces.

    The mirrored field has at ``R p`` what the original had at ``p``; a vector value is mapped as well.

    Args:
        group: the group that acts.
        positions: sample points in the order of the tensor, ``(P, 2)`` or ``(P, 3)``, in metres, in the
            frame that the group acts on.
        value: how one sample transforms; entries are point-major, ``(P, value.dim)``. Defaults to a
            scalar (one height per point).
        tolerance: distance within which a point counts as found, in metres.

    Raises:
        ValueError: the layout is not closed under the group; the message names the element and point.

    Example:
        >>> ring = points(PointGroup.reflection("y"), [[1.0, 0.5], [1.0, -0.5], [2.0, 0.0]])
        >>> ring(torch.tensor([10.0, 20.0, 30.0]), "reflect-y")
        tensor([20., 10., 30.])
    """
    check_group(group)
    tolerance = checks.real("tolerance", tolerance, 0.0)
    positions = checks.array("positions", positions)
    if positions.ndim != 2 or positions.shape[1] not in (2, 3) or len(positions) == 0:
        raise ValueError(f"expected positions of shape (P, 2) or (P, 3), got {tuple(positions.shape)}")
    turns = _horizontal(group) if positions.shape[1] == 2 else group.matrices
    moved = positions @ turns.mT  # (N, P, 2|3)
    distance, landing = torch.cdist(moved, positions.expand_as(moved)).min(dim=-1)
    if (distance > tolerance).any():
        g, i = (distance > tolerance).nonzero()[0].tolist()
        raise ValueError(
            f"the points are not closed under {group.names[g]!r}: point {i} at "
            f"{_metres(positions[i])} is sent to {_metres(moved[g, i])}, where there is none; center "
            "the layout on the axis of the group (for turns of 120 degrees use rings, not a grid)"
        )
    if (landing.sort(dim=-1).values != torch.arange(len(positions), device="cpu")).any():
        raise ValueError(f"expected distinct points, got two within {tolerance} m of each other")
    index = landing.argsort(dim=-1)  # entry landing[g, i] of the image comes from entry i
    heights = Representation.from_blocks(group, [SignedPermutation(index, torch.ones_like(index))])
    if value is None:
        return heights
    if checks.instance("value", value, Representation).group != group:
        raise ValueError(f"expected a value of the same group, got {value.group}")
    products = [torch.kron(a, b) for a, b in zip(heights.matrices, value.matrices, strict=True)]
    return Representation(group, torch.stack(products))


def height_map(
    group: PointGroup, x: Sequence[float] | Tensor, y: Sequence[float] | Tensor
) -> Representation:
    """Heights on the grid ``x`` times ``y`` (metres, robot frame), x-major: entry ``i * len(y) + j``.

    Raises:
        ValueError: the grid is not closed under the group: off-center, or turned by less than 90 degrees.

    Example:
        >>> grid = height_map(PointGroup.klein_four(), x=[-0.1, 0.0, 0.1], y=[-0.1, 0.1])
        >>> grid(torch.arange(6.0), "reflect-x")
        tensor([4., 5., 2., 3., 0., 1.])
    """
    axes = [checks.array(name, values) for name, values in (("x", x), ("y", y))]
    for name, lines in zip("xy", axes, strict=True):
        if lines.ndim != 1 or len(lines) == 0:
            raise ValueError(f"{name}: expected a list of coordinates, got shape {tuple(lines.shape)}")
    return points(group, torch.cartesian_prod(*axes))


def _metres(point: Tensor) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in point.tolist()) + ")"
