"""What an environment reads and writes, as TorchRL's specs."""

from __future__ import annotations

from typing import Any

import torch
from torchrl.data import Binary, Bounded, Composite, Unbounded

from tasks.base import Task
from torchrl_sym import checks


def make_specs(
    task: Task, num_envs: int, device: torch.device | None = None
) -> tuple[Composite, Bounded, Unbounded, Composite]:
    """Specs of observation, action, reward and the flags of an episode's end, of n simulations.

    Args:
        task: whose sizes they have.
        num_envs: number of simulations n.
        device: of the tensors; None for the CPU.

    Example:
        >>> from tasks.base import create
        >>> make_specs(create("cartpole"), 2)[1].shape
        torch.Size([2, 1])
    """
    checks.instance("task", task, Task, "tasks.base.create makes one")
    n = checks.whole("num_envs", num_envs, 1)
    real: dict[str, Any] = {"dtype": torch.float32, "device": device}

    def flag() -> Binary:
        return Binary(1, shape=torch.Size((n, 1)), dtype=torch.bool, device=device)

    observation = Unbounded(torch.Size((n, task.observation_size)), **real)
    return (
        Composite(observation=observation, shape=(n,)),
        Bounded(-1.0, 1.0, shape=torch.Size((n, task.action_size)), **real),
        Unbounded(torch.Size((n, 1)), **real),
        Composite(done=flag(), terminated=flag(), truncated=flag(), shape=(n,)),
    )
