"""Environments by the name of their task."""

from __future__ import annotations

from typing import Any

import torch

from tasks.base import create
from tasks.engines import EngineName
from tasks.environment import BatchedEnv


def make_env(
    name: str,
    *,
    num_envs: int = 64,
    num_threads: int = 2,
    seed: int | None = None,
    device: torch.device | str | None = None,
    engine: EngineName | None = None,
    **task_kwargs: Any,
) -> BatchedEnv:
    """Batched TorchRL environment of a task, by name.

    Args:
        name: one of ``tasks.ALL_TASKS``.
        num_envs: number of simulations.
        num_threads: physics threads on the CPU, 0 for all cores; does not change the results.
        seed: seed of all start states. Defaults to a draw from torch's global generator.
        device: where tensors go. On ``"cuda"`` the physics runs there too, in single precision, by
            mujoco_warp; on the CPU, the default, by MuJoCo itself.
        engine: ``"mujoco"`` for the physics on CPU threads, whatever the device, or ``"warp"``.
        **task_kwargs: arguments of the task, such as ``episode_seconds``.

    Raises:
        KeyError: no such task; the message lists the names.
        TypeError: an argument that the task does not take.
        ImportError: the physics on a GPU is not installed; the message says which extra brings it.

    Example:
        >>> import tasks
        >>> env = tasks.make_env("cartpole", num_envs=16, num_threads=1, seed=0)
        >>> env.reset()["observation"].shape
        torch.Size([16, 3])
    """
    task = create(name, **task_kwargs)
    return BatchedEnv(task, num_envs, num_threads=num_threads, seed=seed, device=device, engine=engine)
