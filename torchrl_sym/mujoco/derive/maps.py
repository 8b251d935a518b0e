"""Matrices of all elements, as representations, and affine maps of coordinates whose zero is not kept."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.model.types import Array
from torchrl_sym.representations import Representation
from torchrl_sym.representations.blocks import SignedPermutation, block_from_matrices


class Affine:
    """x -> rho(g) x + c(g): coordinates whose zero the group does not keep."""

    def __init__(self, linear: Representation, offsets: Sequence[Array]) -> None:
        self.linear = linear
        self.offset = torch.as_tensor(np.stack(offsets))  # (N, d)
        self.moves = bool(self.offset.any())
        self.casts: dict[tuple[torch.dtype, torch.device], Tensor] = {}

    def __call__(self, x: Tensor, g: int | str | Tensor) -> Tensor:
        image = self.linear(x, g)
        if not self.moves:
            return image
        kind = (image.dtype, image.device)
        if kind not in self.casts:
            self.casts[kind] = self.offset.to(image)
        offset = self.casts[kind]
        if not isinstance(g, Tensor):
            return image + offset[self.linear.group.index(g)]
        rows = offset.index_select(0, g.flatten())
        return image + rows.view(*g.shape, *[1] * (x.ndim - 1 - g.ndim), -1)


def represent(group: PointGroup, matrices: Sequence[Array]) -> Representation:
    """The representation with these matrices, one per element, in as many blocks as they allow."""
    if matrices[0].shape[0] == 0:
        empty = torch.zeros(group.order, 0)
        return Representation.from_blocks(group, [SignedPermutation(empty, empty)], check=False)
    whole = np.stack(matrices)
    block = block_from_matrices(torch.as_tensor(whole))
    if isinstance(block, SignedPermutation):
        return Representation.from_blocks(group, [block])
    used = (whole != 0).any(axis=0)
    used |= used.T
    # cut wherever no entry reaches across, so that joints beside a turned cube are still permuted
    furthest = [max(i, int(np.flatnonzero(row).max(initial=0))) for i, row in enumerate(used)]
    ends = [i + 1 for i, last in enumerate(np.maximum.accumulate(furthest)) if last == i]
    parts = [slice(a, b) for a, b in zip([0, *ends[:-1]], ends, strict=True)]
    blocks = [block_from_matrices(torch.as_tensor(whole[:, part, part])) for part in parts]
    return Representation.from_blocks(group, blocks)
