"""Builders for what physics measures: scalars, vectors, headings and orientations.

With R the 3 x 3 matrix of an element and d its determinant:

=====================  ====================================  =======================================
builder                matrix                                measures
=====================  ====================================  =======================================
``scalar``             1                                     time left, mass, contact force magnitude
``pseudoscalar``       d                                     yaw rate, heading error, cart position
``polar``              R                                     velocity, force, gravity, position
``axial``              d R                                   angular velocity, torque
``planar``             upper left 2 x 2 of R                 horizontal part of a polar vector
``heading``            diag(1, d)                            (cos, sin) of a heading error
=====================  ====================================  =======================================

Vectors are given in a frame that turns with the robot (base frame), or in a world frame about which the
group acts; both transform by the same R.
"""

from __future__ import annotations

import torch

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup, check_group
from torchrl_sym.representations.base import MAX_DIM, Representation
from torchrl_sym.representations.blocks import SignedPermutation


def invariant(group: PointGroup, dim: int) -> Representation:
    """Entries that no element changes.

    Example:
        >>> invariant(PointGroup.reflection("y"), 4).dim
        4
    """
    sign = torch.ones(check_group(group).order, checks.whole("dim", dim, 1, MAX_DIM), device="cpu")
    index = torch.arange(sign.shape[1], device="cpu").expand_as(sign)
    return Representation.from_blocks(group, [SignedPermutation(index, sign)], check=False)


def scalar(group: PointGroup) -> Representation:
    """One entry that no element changes: time left, mass, a force's magnitude."""
    return invariant(group, 1)


def pseudoscalar(group: PointGroup) -> Representation:
    """One entry that reflections negate and rotations keep: yaw rate, heading error.

    A planar task's coordinates are of this kind too: position, velocity and pole angle of a cart-pole
    all change sign under its only reflection.
    """
    return Representation(group, check_group(group).det[:, None, None])


def polar(group: PointGroup) -> Representation:
    """A vector that turns and reflects like a position: velocity, force, gravity, displacement."""
    return Representation(group, check_group(group).matrices)


def axial(group: PointGroup) -> Representation:
    """A vector with a handedness, d R: angular velocity, torque, angular momentum."""
    return Representation(group, check_group(group).det[:, None, None] * group.matrices)


def planar(group: PointGroup) -> Representation:
    """The horizontal part (x, y) of a polar vector.

    Raises:
        ValueError: the group moves the vertical axis, so that (x, y) alone does not transform linearly.
    """
    return Representation(group, _horizontal(group))


def heading(group: PointGroup) -> Representation:
    """(cos, sin) of a heading error about the vertical: a reflection negates the sine."""
    _horizontal(group)
    return scalar(group) + pseudoscalar(group)


def _horizontal(group: PointGroup) -> torch.Tensor:
    moved = (check_group(group).matrices[:, 2, 2] - 1).abs() > 1e-9
    if moved.any():
        name = group.names[int(moved.long().argmax())]
        raise ValueError(
            f"expected a group that fixes the vertical axis, but {name!r} moves it; use polar or axial"
        )
    return group.matrices[:, :2, :2]
