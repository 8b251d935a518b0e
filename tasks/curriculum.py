"""Curricula: how hard the next episode is, judged by how the last one ended.

A level is a whole number that travels with the state of a row: what is hard at it is the task's affair (how
far a target is, how high a box), how it rises and falls is the same for all (`Curriculum`).
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from tasks.draws import device_of
from torchrl_sym import checks

# Weight of one episode in the running averages: they reach back about 500 episodes.
EPISODE_WEIGHT = 0.002


def levels(n: int, level: float, device: torch.device | None = None) -> Tensor:
    """The same level for n rows, ``(n,)`` float64.

    Raises:
        ValueError: a negative number of rows, or a fraction.
    """
    return torch.full((checks.whole("n", n, 0),), float(level), dtype=torch.float64, device=device)


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
    device_of(generator)
    for name, x in (("level", level), ("success", success), ("failure", failure)):
        if not isinstance(x, Tensor) or x.shape != level.shape:
            raise ValueError(f"{name}: expected a tensor with a row per level, got {checks.shown(x)}")
    last = checks.whole("last", last, 1)
    level = (level + success.to(level.dtype) - failure.to(level.dtype)).clamp(min=0.0)
    anywhere = torch.randint(last + 1, level.shape, generator=generator, device=level.device)
    return torch.where(level > last, anywhere.to(level.dtype), level)


class Averages:
    """Running averages over about the last 500 episodes, NaN before the first.

    Args:
        *names: what is averaged.

    Attributes:
        values: the averages by name: numbers, or where :meth:`update_where` made them, on its device.

    Example:
        >>> averages = Averages("success")
        >>> averages.update(success=torch.tensor([True, False]))
        >>> averages.values
        {'success': 0.5}
    """

    def __init__(self, *names: str) -> None:
        self.values: dict[str, Any] = dict.fromkeys(checks.names("names", names), math.nan)

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

    def update_where(self, mask: Tensor, **episodes: Tensor) -> None:
        """:meth:`update` by those of n rows that a mask ``(n,)`` chooses, without asking which they are."""
        checks.refuse_unknown("Averages", episodes, list(self.values))
        count = mask.sum().double()
        for name, figures in episodes.items():
            old = self.values[name]
            if not isinstance(old, Tensor):
                old = torch.full((), old, dtype=torch.float64, device=mask.device)
            mean = torch.where(mask, figures.double(), 0.0).sum() / count
            share = 1 - (1 - EPISODE_WEIGHT) ** count
            new = torch.where(old.isnan(), mean, old + share * (mean - old))
            self.values[name] = torch.where(count > 0, new, old)

    def numbers(self) -> dict[str, float]:
        """The averages as numbers of Python's; a device is waited for."""
        return {name: float(value) for name, value in self.values.items()}

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


class Curriculum:
    """Levels of the next episodes, from how the last ones ended, and averages over those.

    Args:
        last: the highest level.
        *figures: what is averaged over whole episodes, in this order; ``success`` and ``level`` among it.
        rising: whether episodes begin at level 0 and rise with success; if not, all are of the last level.

    Attributes:
        last: the highest level.
        rising: whether levels rise.
        averages: the running averages.

    Example:
        >>> curriculum = Curriculum(7, "success", "level")
        >>> yes, no = torch.tensor([True, True]), torch.tensor([False, False])
        >>> curriculum.judge(curriculum.start(2), whole=yes, success=~no, failed=no, generator=None)
        tensor([1., 1.], dtype=torch.float64)
        >>> curriculum.averages.values
        {'success': 1.0, 'level': 0.0}
    """

    def __init__(self, last: int, *figures: str, rising: bool = True) -> None:
        self.last = checks.whole("last", last, 1)
        self.rising = checks.flag("curriculum", rising)
        self.averages = Averages(*figures)

    def start(self, n: int, generator: torch.Generator | None = None) -> Tensor:
        """Levels of n rows that have not played yet, ``(n,)``, where the generator draws."""
        return levels(n, 0 if self.rising else self.last, device_of(generator))

    def hardest(self, n: int, generator: torch.Generator | None = None) -> Tensor:
        """The last level, that of the task itself, for n rows, ``(n,)``, where the generator draws."""
        return levels(n, self.last, device_of(generator))

    def judge(
        self,
        level: Tensor,
        *,
        whole: Tensor,
        success: Tensor,
        failed: Tensor,
        generator: torch.Generator | None,
        rows: Tensor | None = None,
        **figures: Tensor,
    ) -> Tensor:
        """Levels of the next episodes, ``(n,)``: one up after success, one down after failure.

        Args:
            level: levels of the last ones, ``(n,)``.
            whole: which of them were played to an end; the others say nothing, and are repeated.
            success: which of them succeeded.
            failed: which failed badly, unless they succeeded.
            generator: source of the draws.
            rows: a mask of the rows that are judged, on a device; the levels of others mean nothing then.
            **figures: what else is averaged.
        """
        success = whole & success
        ended = {"success": success, "level": level, **figures}
        if rows is None:
            self.averages.update(**{name: figure[whole] for name, figure in ended.items()})
        else:
            self.averages.update_where(whole & rows, **ended)
        if not self.rising:
            return levels(len(level), self.last, level.device)
        return next_level(level, success, whole & ~success & failed, self.last, generator)
