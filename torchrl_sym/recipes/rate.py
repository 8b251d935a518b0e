"""The learning rate that follows the policy's change, as rsl_rl adapts it.

TorchRL's ``KLAdaptiveLR`` has the same rule in Python numbers: the host then waits for each minibatch of an
accelerator before it can prepare the next. Here a rate that is a tensor is changed where it is.
"""

from __future__ import annotations

import torch
from torch import Tensor


class AdaptiveRate:
    """Divides the learning rate by 1.5 above twice the desired KL, multiplies it by 1.5 below half of it.

    Args:
        optimizer: whose rate it is, a number or a tensor.
        desired_kl: the KL of an update that is aimed at.
        low: lower bound of the rate.
        high: upper bound of the rate.

    Example:
        >>> optimizer = torch.optim.Adam([torch.zeros(1, requires_grad=True)], lr=1e-3)
        >>> rate = AdaptiveRate(optimizer, desired_kl=0.01, low=1e-5, high=1e-2)
        >>> rate.step(torch.tensor(0.001))
        >>> round(float(optimizer.param_groups[0]["lr"]), 6)
        0.0015
    """

    def __init__(
        self, optimizer: torch.optim.Optimizer, desired_kl: float, *, low: float, high: float
    ) -> None:
        self.optimizer, self.desired_kl, self.low, self.high = optimizer, desired_kl, low, high

    def step(self, kl: Tensor) -> None:
        """Adapt the rate to the KL of an update; one that is not a number leaves it as it is."""
        for group in self.optimizer.param_groups:
            rate = group["lr"]
            value = kl if isinstance(rate, Tensor) else kl.item()  # numbers are cheaper, where nobody waits
            small, large = (value > 0) * (value < self.desired_kl / 2), value > 2 * self.desired_kl
            factor = 1.5 ** (small * 1 - large * 1)
            if isinstance(rate, Tensor):
                rate.mul_(factor).clamp_(self.low, self.high)
            else:
                group["lr"] = sorted((self.low, self.high, rate * factor))[1]
