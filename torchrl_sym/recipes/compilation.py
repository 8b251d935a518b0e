"""Compiled losses and recorded updates.

A compiled loss takes a fifth less time of a small network's update, after a minute of compilation. On CUDA,
the whole update is recorded into a graph, too.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_sym.recipes.ranks import Ranks
from torchrl_sym.recipes.recording import Recorded


def compiled(function: Callable, device: str) -> Callable:
    """A function that ``torch.compile`` compiles when it is first called.

    It is returned as it is, with a warning, where compilation does not work: on a CPU it needs a C++
    compiler, on a GPU Triton.
    """
    try:
        torch.compile(_trial)(torch.ones(2, device=device))
    except Exception as error:  # each backend has errors of its own
        reason = str(error).strip().splitlines() or [type(error).__name__]
        warnings.warn(
            f"compile: training goes on without, since torch.compile does not work here ({reason[0]}); "
            "install a C++ compiler, or leave it off",
            RuntimeWarning,
            stacklevel=4,
        )
        return function
    return torch.compile(function)


def recorded(
    update: Callable[[TensorDictBase], Tensor], device: str, ranks: Ranks
) -> Callable[[TensorDictBase], Tensor]:
    """An update that becomes a CUDA graph, on CUDA; itself elsewhere, and where processes share it."""
    if torch.device(device).type != "cuda":
        return update
    if ranks.count > 1:
        warnings.warn(
            "compile: updates are not recorded into CUDA graphs, since several processes exchange their "
            "gradients in each; the losses are compiled all the same",
            RuntimeWarning,
            stacklevel=4,
        )
        return update
    return Recorded(update)


def _trial(x: torch.Tensor) -> torch.Tensor:
    return x * 2 + 1
