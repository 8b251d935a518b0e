"""What a batch must not contain: numbers that are not finite, which nobody can learn from."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor


def vital(keys: Iterable[NestedKey]) -> list[NestedKey]:
    """What of a batch must be finite: the observations of these keys, actions and rewards."""
    keys = list(dict.fromkeys(keys))
    return [*keys, *(("next", key) for key in keys), "action", ("next", "reward")]


def finite(data: TensorDictBase, names: Iterable[NestedKey]) -> Tensor:
    """Whether all numbers of each entry are, where the batch is."""
    return torch.stack([data.get(name).isfinite().all() for name in names])


def require_finite(data: TensorDictBase, names: Iterable[NestedKey], flags: Tensor) -> None:
    """FloatingPointError, which names the first entry that is not :func:`finite`."""
    for name in (name for name, good in zip(names, flags.tolist(), strict=True) if not good):
        wrong = data.get(name).isfinite().logical_not()
        bad = int(wrong.flatten(data.ndim).any(-1).sum())
        raise FloatingPointError(
            f"expected finite numbers, got others in {name!r} of {bad} of {data.numel()} samples; end "
            "episodes before the simulation diverges"
        )
