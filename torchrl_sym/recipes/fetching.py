"""Numbers for the host, fetched once per iteration.

Whoever asks an accelerator for a number waits until all that was queued before it is done, and nothing is
queued meanwhile. So what an iteration measures stays where it was measured until the iteration is over, and
comes to the host in one piece.
"""

from __future__ import annotations

import torch
from torch import Tensor


def fetch(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors on the CPU, in a single transfer; those that are there are returned themselves.

    Args:
        tensors: of any shapes, some on the CPU and all others on one device; of those, numbers of which the
            kind of one holds all, as float32 does bool.

    Example:
        >>> import torch
        >>> fetch({"kl": torch.tensor(0.5), "done": torch.tensor([True, False])})
        {'kl': tensor(0.5000), 'done': tensor([ True, False])}
    """
    away = {name: value for name, value in tensors.items() if value.device.type != "cpu"}
    return tensors | unpack(pack(away).cpu(), away) if away else tensors


def pack(tensors: dict[str, Tensor]) -> Tensor:
    """All numbers of some tensors, one after the other."""
    return torch.cat([value.detach().reshape(-1) for value in tensors.values()])


def unpack(packed: Tensor, like: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors again, with shapes and kinds of their originals."""
    parts = packed.split([value.numel() for value in like.values()])
    return {
        name: part.reshape(value.shape).to(value.dtype)
        for (name, value), part in zip(like.items(), parts, strict=True)
    }
