"""Random draws of start states and of the physics, all from the generator that a caller hands in.

An environment's generator is part of its saved state: a draw from anywhere else would make two runs of one
seed differ.
"""

from __future__ import annotations

from collections.abc import Mapping, Set

import torch
from torch import Tensor

from torchrl_sym import checks

Range = tuple[float, float]


def draws(n: int, size: int, generator: torch.Generator | None) -> Tensor:
    """Uniform draws from 0 to 1, ``(n, size)`` float64; a row per simulation.

    Raises:
        TypeError: a generator of another library, or a seed.
    """
    check_generator(generator)
    return torch.rand(checks.whole("n", n, 0), size, generator=generator, dtype=torch.float64)


def uniform(span: Range, n: int, generator: torch.Generator | None) -> Tensor:
    """Uniform draws of a range, ``(n,)`` float64."""
    low, high = span
    return low + (high - low) * draws(n, 1, generator)[:, 0]


def check_generator(generator: torch.Generator | None) -> None:
    """TypeError unless it is torch's, or None for the global one."""
    if generator is not None:
        checks.instance(
            "generator", generator, torch.Generator, "torch.Generator().manual_seed(seed) is one"
        )


def check_range(name: str, span: Range | None, above: float) -> Range | None:
    """A range of random draws: rising, finite and above a bound; None for none.

    Raises:
        TypeError: not two numbers; the message names the argument.
        ValueError: other than such a range.
    """
    if span is None:
        return None
    wrong = f"{name}: expected a rising range above {above:g}, got {checks.shown(span)}"
    if isinstance(span, Mapping | Set) or len(checks.sequence(name, span, of="two numbers")) != 2:
        raise ValueError(f"{wrong}; write (lowest, highest)")
    try:
        low = checks.real(name, span[0], above=above)
        return low, checks.real(name, span[1], low)
    except (TypeError, ValueError) as error:
        raise type(error)(wrong) from error
