"""Builders for orientations: rotation matrices, the 6-d encoding and quaternions.

An orientation X of an object is carried to ``R X`` when only the world is turned ("left"), or to
``R X R^T`` when the object's own frame is turned along ("conjugate"). A reflection turns a rotation into
an improper matrix from one side, so groups with reflections need "conjugate", which is right for
objects that are themselves mirror symmetric in the planes of the group (a cube, a base, a foot).
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup, check_group
from torchrl_sym.representations.base import Representation
from torchrl_sym.representations.vectors import _horizontal

Action = Literal["left", "conjugate"]


def rotation_matrix(group: PointGroup, action: Action = "left") -> Representation:
    """A 3 x 3 rotation matrix, flattened row by row (9 entries).

    Args:
        group: the group that acts.
        action: ``"left"``: X to R X (rotations only). ``"conjugate"``: X to R X R^T.
    """
    _check_action(group, action, "rotation_matrix")
    right = group.matrices if action == "conjugate" else _eye(group, 3)
    return Representation(group, _kron(group.matrices, right))


def rotation_6d(
    group: PointGroup, action: Action = "left", layout: Literal["columns", "rows"] = "columns"
) -> Representation:
    """The first two columns (or rows) of a rotation matrix, one after the other (6 entries).

    The encoding of Zhou et al. 2019 (arXiv:1812.07035) uses columns; some libraries store rows.

    Args:
        group: the group that acts; it must fix the vertical axis, except for left action on columns.
        action: as in :func:`rotation_matrix`.
        layout: whether the six entries are two columns or two rows.
    """
    _check_action(group, action, "rotation_6d")
    checks.one_of("layout", layout, ("columns", "rows"))
    two, full = _eye(group, 2), group.matrices
    if layout == "columns":  # column k of R X R^T is sum_j R_kj R x_j
        pair = _horizontal(group) if action == "conjugate" else two
        return Representation(group, _kron(pair, full))
    other = full if action == "conjugate" else _eye(group, 3)  # row k of R X is sum_j R_kj row_j
    return Representation(group, _kron(_horizontal(group), other))


def quaternion(group: PointGroup, action: Action = "left", *, scalar_last: bool = False) -> Representation:
    """A unit quaternion (w, x, y, z), as in MuJoCo.

    Left multiplication with the quaternion q_g of a rotation composes only up to sign: three turns of
    120 degrees give -q. Of the two lifts +q_g and -q_g this function takes the one with rho(g)^n = +I,
    which exists exactly for turns of odd order (docs/concepts.md has the argument). For 180 degrees there
    is none (q_g squared is -1 with either sign), and the group is refused.

    Conjugation, q to q_R q q_R^-1 with R replaced by det(R) R, is free of this and covers reflections.

    Args:
        group: the group that acts.
        action: as in :func:`rotation_matrix`.
        scalar_last: entries are (x, y, z, w) instead of (w, x, y, z).

    Raises:
        ValueError: left action of a reflection, or of a turn of even order; the message names it.

    Example:
        >>> turn = quaternion(PointGroup.rotation(3)).matrices[1]
        >>> bool(torch.allclose(turn @ turn @ turn, torch.eye(4, dtype=turn.dtype)))
        True
    """
    _check_action(group, action, "quaternion")
    checks.flag("scalar_last", scalar_last)
    proper = group.det[:, None, None] * group.matrices
    turns = [_to_quaternion(m) for m in proper]
    left = torch.stack([_left_product(q) for q in turns])
    if action == "conjugate":
        inverse = torch.tensor([1.0, -1, -1, -1], dtype=torch.float64, device="cpu")  # of this q, not of -q
        matrices = left @ torch.stack([_right_product(inverse * q) for q in turns])
    else:
        matrices = _lift(group, left)
    if scalar_last:
        order = torch.tensor([1, 2, 3, 0], device="cpu")
        matrices = matrices[:, order][:, :, order]
    return Representation(group, matrices)


def _lift(group: PointGroup, left: Tensor) -> Tensor:
    lifted = []
    for matrix, n, name in zip(left, group.element_order, group.names, strict=True):
        sign = torch.linalg.matrix_power(matrix, n)[0, 0].sign()  # rho(g)^n is +I or -I
        if n % 2 == 0:
            raise ValueError(
                f"no representation: the quaternion of {name!r} has order {2 * n} with either sign, "
                f"since its power {n} is {'+' if sign > 0 else '-'}1; observe the orientation as "
                "rotation_matrix or rotation_6d, or use action='conjugate'"
            )
        lifted.append(sign * matrix)  # (-1)^n = -1 for odd n
    return torch.stack(lifted)


def _check_action(group: PointGroup, action: str, builder: str) -> None:
    check_group(group)
    checks.one_of("action", action, ("left", "conjugate"))
    if action == "left" and (group.det < 0).any():
        name = group.names[int(group.det.argmin())]
        raise ValueError(
            f"{name!r} is a reflection, which turns an orientation into an improper matrix from the "
            f"left; use {builder}(group, action='conjugate')"
        )


def _to_quaternion(matrix: Tensor) -> Tensor:
    """(w, x, y, z) of a rotation matrix, dividing by its largest entry (Shepperd, 1978)."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = matrix.flatten().tolist()
    candidates = [1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz]
    largest = max(range(4), key=lambda i: candidates[i])
    s = 2 * math.sqrt(candidates[largest])
    rows = [
        [s / 4, (zy - yz) / s, (xz - zx) / s, (yx - xy) / s],
        [(zy - yz) / s, s / 4, (xy + yx) / s, (xz + zx) / s],
        [(xz - zx) / s, (xy + yx) / s, s / 4, (yz + zy) / s],
        [(yx - xy) / s, (xz + zx) / s, (yz + zy) / s, s / 4],
    ]
    return torch.tensor(rows[largest], dtype=torch.float64, device="cpu")


def _left_product(q: Tensor) -> Tensor:
    w, x, y, z = q.tolist()
    return torch.tensor(
        [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float64, device="cpu"
    )


def _right_product(q: Tensor) -> Tensor:
    w, x, y, z = q.tolist()
    return torch.tensor(
        [[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]], dtype=torch.float64, device="cpu"
    )


def _eye(group: PointGroup, size: int) -> Tensor:
    return torch.eye(size, dtype=torch.float64, device="cpu").expand(group.order, size, size)


def _kron(a: Tensor, b: Tensor) -> Tensor:
    return torch.stack([torch.kron(x.contiguous(), y.contiguous()) for x, y in zip(a, b, strict=True)])
