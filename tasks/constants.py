"""Fixed numbers of a task as tensors, wherever and in whichever precision the state is."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchrl_sym import checks


class Constant:
    """A tensor of fixed numbers; :meth:`like` gives it on the device and in the dtype of what it meets.

    Each copy is made once, so that later uses neither transfer anything nor wait. Do not write into one.

    Args:
        values: a tensor, an array or nested lists. Whole numbers of a tensor, such as indices, stay whole.

    Attributes:
        values: the numbers on the CPU, float64 or whole.

    Example:
        >>> pose = Constant([0.4, -0.8])
        >>> torch.ones(2) - pose.like(torch.ones(2))
        tensor([0.6000, 1.8000])
        >>> pose.like(torch.ones(2, device="meta")).device
        device(type='meta')
    """

    def __init__(self, values: Any) -> None:
        whole = isinstance(values, Tensor) and values.dtype == torch.int64
        self.values = (values if whole else checks.array("values", values)).clone()
        self._copies: dict[tuple[torch.dtype, torch.device], Tensor] = {}

    def like(self, x: Tensor) -> Tensor:
        """The numbers on the device and in the dtype of ``x``."""
        kind = (x.dtype, x.device)
        if kind not in self._copies:
            dtype = x.dtype if self.values.is_floating_point() else None
            self._copies[kind] = self.values.to(x.device, dtype)
        return self._copies[kind]

    def __reduce__(self) -> tuple[type[Constant], tuple[Tensor]]:
        return Constant, (self.values,)
