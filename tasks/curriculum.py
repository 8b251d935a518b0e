"""Curricula: how hard the next episode is, judged by how the last one ended.

A level is a whole number that travels with the state of a row: what is hard at it is the task's affair (how
far a target is, how high a box), how it rises and falls is the same for all (`Curriculum`).
"""

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

    def start(self, n: int) -> Tensor:
        """Levels of n rows that have not played yet, ``(n,)``."""
        return levels(n, 0 if self.rising else self.last)

    def hardest(self, n: int) -> Tensor:
        """The last level, that of the task itself, for n rows, ``(n,)``."""
        return levels(n, self.last)

    def judge(
        self,
        level: Tensor,
        *,
        whole: Tensor,
        success: Tensor,
        failed: Tensor,
        generator: torch.Generator | None,
        **figures: Tensor,
    ) -> Tensor:
        """Levels of the next episodes, ``(n,)``: one up after success, one down after failure.

        Args:
            level: levels of the last ones, ``(n,)``.
            whole: which of them were played to an end; the others say nothing, and are repeated.
            success: which of them succeeded.
            failed: which failed badly, unless they succeeded.
            generator: source of the draws.
            **figures: what else is averaged.
        """
        success = whole & success
        ended = {"success": success, "level": level, **figures}
        self.averages.update(**{name: figure[whole] for name, figure in ended.items()})
        if not self.rising:
            return self.hardest(len(level))
        return next_level(level, success, whole & ~success & failed, self.last, generator)
