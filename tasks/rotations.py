"""Batched rotations of rigid bodies."""

from __future__ import annotations

import torch
from torch import Tensor


def matrix_of(quaternion: Tensor) -> Tensor:
    """Rotation matrix of unit quaternions ``(n, 4)``, (w, x, y, z)."""
    w, x, y, z = quaternion.unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
