"""Random draws of start states and of the physics, all from the generator that a caller hands in.

An environment's generator is part of its saved state: a draw from anywhere else would make two runs of one
seed differ. Draws are made where the generator is, so that start states are born on the device of the
simulation.
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
    n, device = checks.whole("n", n, 0), device_of(generator)
    return torch.rand(n, size, generator=generator, dtype=torch.float64, device=device)


def uniform(span: Range, n: int, generator: torch.Generator | None) -> Tensor:
    """Uniform draws of a range, ``(n,)`` float64."""
    low, high = span
    return low + (high - low) * draws(n, 1, generator)[:, 0]


def device_of(generator: torch.Generator | None) -> torch.device:
    """Where a generator draws; None stands for the global one, on the CPU.

    Raises:
        TypeError: a generator of another library, or a seed.
    """
    if generator is None:
        return torch.device("cpu")
    remedy = "torch.Generator().manual_seed(seed) is one"
    return checks.instance("generator", generator, torch.Generator, remedy).device


def put(own: Tensor, rows: Tensor, values: Tensor) -> None:
    """Write rows of a live tensor ``(n, ...)`` in place.

    Args:
        own: what is written to.
        rows: k row numbers; or a mask of all n rows, as on a device, which cannot say how many it has
            without being waited for.
        values: ``(k, ...)``, or ``(n, ...)``, of which the mask chooses.

    Example:
        >>> own = torch.zeros(3)
        >>> put(own, torch.tensor([2]), torch.ones(1)), put(own, own == 0, torch.full((3,), 7.0))
        (None, None)
        >>> own
        tensor([7., 7., 1.])
    """
    if rows.dtype != torch.bool:
        own[rows] = values.to(own.dtype)
    else:
        own.copy_(torch.where(rows.view(-1, *[1] * (own.ndim - 1)), values, own))


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
