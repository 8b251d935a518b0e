"""Curricula: how hard the next episode is, judged by how the last one ended."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from tasks.draws import check_generator
from torchrl_sym import checks

# Weight of one episode in the running averages: they reach back about 500 episodes.
EPISODE_WEIGHT = 0.002


def levels(n: int, level: float) -> Tensor:
    """The same level for n rows, ``(n,)`` float64.

    Raises:
        ValueError: a negative number of rows, or a fraction.
    """
    return torch.full((checks.whole("n", n, 0),), float(level), dtype=torch.float64)


def next_level(
    level: Tensor, success: Tensor, failure: Tensor, last: int, generator: torch.Generator | None
) -> Tensor:
    """One up after success, one down after failure; whoever passes the last level starts anywhere.

    The restart at any level keeps easy episodes in the data, so that they are not forgotten.

    Args:
        level: levels of the finished episodes, ``(n,)``, whole numbers as float.
        success: which of them succeeded, ``(n,)`` bool.
        failure: which of them failed, ``(n,)`` bool; an episode may be neither.
        last: the highest level.
        generator: source of the draws.

    Raises:
        ValueError: outcomes of other rows than the levels are.
        TypeError: an argument of another type.

    Example:
        >>> level, yes = torch.tensor([0.0, 3.0]), torch.tensor([True, False])
        >>> next_level(level, yes, ~yes, 7, None)
        tensor([1., 2.])
    """
    check_generator(generator)
    for name, x in (("level", level), ("success", success), ("failure", failure)):
        if not isinstance(x, Tensor) or x.shape != level.shape:
            raise ValueError(f"{name}: expected a tensor with a row per level, got {checks.shown(x)}")
    last = checks.whole("last", last, 1)
    level = (level + success.to(level.dtype) - failure.to(level.dtype)).clamp(min=0.0)
    anywhere = torch.randint(last + 1, level.shape, generator=generator).to(level.dtype)
    return torch.where(level > last, anywhere, level)


class Averages:
    """Running averages over about the last 500 episodes, NaN before the first.

    Args:
        *names: what is averaged.

    Example:
        >>> averages = Averages("success")
        >>> averages.update(success=torch.tensor([True, False]))
        >>> averages.values
        {'success': 0.5}
    """

    def __init__(self, *names: str) -> None:
        self.values = dict.fromkeys(checks.names("names", names), math.nan)

    def update(self, **episodes: Tensor) -> None:
        """Take in the figures of finished episodes, ``(n,)`` each; n may be 0."""
        checks.refuse_unknown("Averages", episodes, list(self.values))
        for name, figures in episodes.items():
            if not isinstance(figures, Tensor) or figures.ndim != 1:
                raise ValueError(f"{name}: expected a tensor (n,), got {checks.shown(figures)}")
            if not len(figures):
                continue
            mean, old = float(figures.double().mean()), self.values[name]
            share = 1.0 if math.isnan(old) else 1 - (1 - EPISODE_WEIGHT) ** len(figures)
            self.values[name] = mean if math.isnan(old) else old + share * (mean - old)

    def load(self, values: dict[str, float]) -> None:
        """Continue from ``values``; what another version of the task did not average begins anew.

        Raises:
            TypeError: no mapping to numbers.
        """
        checks.mapping("averages", values, "names to numbers")
        for name, value in values.items():
            if isinstance(value, bool) or not isinstance(value, float | int):
                raise TypeError(f"average {name!r}: expected a number, got {checks.shown(value)}")
        self.values = {name: float(values.get(name, math.nan)) for name in self.values}
