"""Tensors that belong to a group, not to a module: they follow the data and never change precision.

A buffer would be rounded by ``module.to(torch.bfloat16)`` and stay behind when only the data moves to a
GPU. These tensors are kept on the CPU in full precision; the first use on another device makes a copy
there, which later uses find, so that they cause neither a transfer nor a wait.
"""

from __future__ import annotations

import torch
from torch import Tensor


class Constants:
    """Tensors on the CPU and their copies elsewhere.

    Copies are neither pickled nor deep-copied with their owner.

    Example:
        >>> Constants(torch.eye(2)).on(torch.device("meta"))[0].device
        device(type='meta')
    """

    def __init__(self, *tensors: Tensor) -> None:
        self.tensors = tuple(tensor.cpu() for tensor in tensors)
        self._copies: dict[torch.device, tuple[Tensor, ...]] = {}

    def on(self, device: torch.device) -> tuple[Tensor, ...]:
        """The tensors on a device; float64 is float32 on ``mps``, which has no float64."""
        if device.type == "cpu":
            return self.tensors
        if torch.compiler.is_compiling():
            return self._while_tracing(device)
        return self._on(device)

    @torch.compiler.assume_constant_result
    def _while_tracing(self, device: torch.device) -> tuple[Tensor, ...]:
        return self._on(device)

    def _on(self, device: torch.device) -> tuple[Tensor, ...]:
        if device in self._copies:
            return self._copies[device]
        with torch.inference_mode(False):  # a later use may need gradients
            copies = tuple(_moved(tensor, device) for tensor in self.tensors)
        if all(type(copy) is Tensor for copy in copies):  # and not the fakes of somebody who traces
            self._copies[device] = copies
        return copies

    def __reduce__(self) -> tuple[type[Constants], tuple[Tensor, ...]]:
        return Constants, self.tensors


def _moved(tensor: Tensor, device: torch.device) -> Tensor:
    narrow = device.type == "mps" and tensor.dtype == torch.float64
    return tensor.to(device, torch.float32 if narrow else tensor.dtype)
