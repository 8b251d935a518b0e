"""The regular representation: the group permutes copies of itself.

One copy has an entry for every element, and g moves the entry of h to that of g h. It is the only
representation that every other is a part of, and it only moves entries, so that any function of single
entries commutes with it: hidden units of an equivariant network are copies of it.
"""

from __future__ import annotations

import torch

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup, check_group
from torchrl_sym.representations.base import MAX_DIM, Representation
from torchrl_sym.representations.blocks import SignedPermutation


def regular(group: PointGroup, channels: int = 1) -> Representation:
    """Copies of the group, permuted by it: the entry (h, c) of the image under g is that of (g^-1 h, c).

    Args:
        group: the group that acts, of order N.
        channels: number of copies; events have N * channels entries, ``[element, channel]``.

    Example:
        >>> regular(PointGroup.reflection("y"), 2)(torch.tensor([1.0, 2.0, 3.0, 4.0]), "reflect-y")
        tensor([3., 4., 1., 2.])
    """
    order = check_group(group).order
    channels = checks.whole("channels", channels, 1, MAX_DIM // order)
    entries = torch.arange(order * channels, device="cpu").reshape(order, channels)
    index = entries[group.table[group.inverse]].flatten(1)
    return Representation.from_blocks(
        group, [SignedPermutation(index, torch.ones_like(index))], check=False
    )
