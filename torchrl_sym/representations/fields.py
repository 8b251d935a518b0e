"""Builders for fields sampled at points: height maps, range finders.

They need no table at all: the group moves the sample points, and the builder finds where each one lands.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup, check_group
from torchrl_sym.representations.base import MAX_DIM, Representation
from torchrl_sym.representations.blocks import SignedPermutation
from torchrl_sym.representations.items import items
from torchrl_sym.representations.nearest import nearest
from torchrl_sym.representations.vectors import _horizontal


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
    twice = f"expected distinct points, got two within {tolerance} m of each other"
    if len(positions.unique(dim=0)) < len(positions):
        raise ValueError(twice)
    turns = _horizontal(group) if positions.shape[1] == 2 else group.matrices
    moved = positions @ turns.mT  # (N, P, 2|3)
    landing = nearest(moved.flatten(0, 1), positions, tolerance).view(moved.shape[:2])
    if (landing < 0).any():
        g, i = (landing < 0).nonzero()[0].tolist()
        raise ValueError(
            f"the points are not closed under {group.names[g]!r}: point {i} at "
            f"{_metres(positions[i])} is sent to {_metres(moved[g, i])}, where there is none; center "
            "the layout on the axis of the group (for turns of 120 degrees use rings, not a grid)"
        )
    if (landing.sort(dim=-1).values != torch.arange(len(positions), device="cpu")).any():
        raise ValueError(twice)
    index = landing.argsort(dim=-1)  # entry landing[g, i] of the image comes from entry i
    heights = Representation.from_blocks(group, [SignedPermutation(index, torch.ones_like(index))])
    return heights if value is None else items(heights, value).flatten()


def height_map(
    group: PointGroup,
    x: Sequence[float] | Tensor,
    y: Sequence[float] | Tensor,
    *,
    order: Literal["yx", "xy"] = "yx",
) -> Representation:
    """Heights on the grid ``x`` times ``y`` (metres, robot frame), as a vector.

    Args:
        group: the group that acts.
        x: coordinates of the grid's lines along x.
        y: coordinates along y.
        order: the axes, the one that runs fastest first. ``"yx"``: entry ``i * len(y) + j`` is at
            ``x[i], y[j]``. ``"xy"``: entry ``j * len(x) + i``, as the scans of Isaac Lab and mjlab have it.
            Both have the same size, so that nothing but this argument can tell them apart.

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
    if len(axes[0]) * len(axes[1]) > MAX_DIM:
        raise ValueError(f"expected at most {MAX_DIM} points, got {len(axes[0])} x {len(axes[1])}")
    if checks.one_of("order", order, ("yx", "xy")) == "yx":
        return points(group, torch.cartesian_prod(*axes))
    return points(group, torch.cartesian_prod(*axes[::-1]).flip(-1))


def _metres(point: Tensor) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in point.tolist()) + ")"
