"""Adam for networks on any device: nothing of a step waits for the host, and its state fits everywhere."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn


class FusedAdam(torch.optim.Adam):
    """Fused Adam, whose learning rate is a number on the CPU, and elsewhere a tensor beside the networks.

    The tensor is always the same one, so that a step which was recorded into a graph reads the rate of the
    moment. ``state_dict`` holds a number: a run may go on elsewhere than it began.

    Args:
        parameters: what it moves, all on one device.
        rate: the learning rate.
        accelerated: whether the rate is a tensor.

    Example:
        >>> import torch
        >>> weight = torch.nn.Parameter(torch.zeros(1))
        >>> optimizer = FusedAdam([weight], rate=0.25, accelerated=True)
        >>> optimizer.param_groups[0]["lr"], optimizer.state_dict()["param_groups"][0]["lr"]
        (tensor(0.2500), 0.25)
    """

    def __init__(self, parameters: Iterable[nn.Parameter], rate: float, accelerated: bool) -> None:
        parameters = list(parameters)
        device = parameters[0].device
        super().__init__(parameters, lr=rate, fused=True, capturable=device.type == "cuda")
        if accelerated:  # as argument, its value would be looked at
            self.param_groups[0]["lr"] = torch.tensor(rate, dtype=torch.float32, device=device)

    @property
    def rate(self) -> Tensor:
        """The learning rate, where it is."""
        rate = self.param_groups[0]["lr"]
        return rate if isinstance(rate, Tensor) else torch.tensor(rate, dtype=torch.float64)

    def state_dict(self) -> dict[str, Any]:
        """That of a training on the CPU, whatever the device."""
        state = super().state_dict()
        for group in state["param_groups"]:
            group |= {"lr": float(group["lr"]), "capturable": False}
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from a state, of whichever device, on this one."""
        own = [(group["lr"], group["capturable"]) for group in self.param_groups]
        super().load_state_dict(state_dict)
        for group, (rate, capturable) in zip(self.param_groups, own, strict=True):
            stored = group["lr"]
            group |= {"lr": rate.fill_(stored) if isinstance(rate, Tensor) else stored}
            group["capturable"] = capturable
