"""Which engine steps the simulations of an environment.

MuJoCo's own library on CPU threads is the default and the reference. On a GPU it is mujoco_warp, which
keeps the state there; it is imported when it is asked for, since it is an extra (``pip install
'torchrl_sym[gpu]'``) and takes seconds.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch

from tasks.base import Task
from tasks.engine import Engine
from tasks.simulation import Simulation
from torchrl_sym import checks
from torchrl_sym.extras import require

EngineName = Literal["mujoco", "warp"]


def make_engine(
    task: Task,
    num_envs: int,
    *,
    num_threads: int = 2,
    device: torch.device | str | None = None,
    engine: EngineName | None = None,
) -> Engine:
    """The simulations of an environment.

    Args:
        task: whose model is simulated.
        num_envs: number of simulations.
        num_threads: physics threads of ``"mujoco"``, 0 for all cores.
        device: of the environment's tensors.
        engine: ``"mujoco"`` on CPU threads, or ``"warp"`` on the device; None for ``"warp"`` on CUDA, else
            ``"mujoco"``.

    Raises:
        ImportError: mujoco_warp is not installed; the message says which extra brings it.
        ValueError: no such engine, or a number out of range.

    Example:
        >>> from tasks.base import create
        >>> make_engine(create("cartpole"), 2, num_threads=1).qpos.shape
        torch.Size([2, 2])
    """
    checks.instance("task", task, Task, "tasks.make_env takes a task's name")
    place = torch.device("cpu" if device is None else device)
    if engine is not None:
        checks.one_of("engine", engine, get_args(EngineName))
    if engine == "mujoco" or (engine is None and place.type != "cuda"):
        return Simulation(task.model, num_envs, num_threads, max_velocity=task.max_velocity)
    remedy = "or engine='mujoco', on CPU threads"
    require("the physics on a GPU", "gpu", {"mujoco_warp": "3.17", "warp": "1.19"}, remedy)
    from tasks.warp_simulation import WarpSimulation

    return WarpSimulation(task.model, num_envs, place, max_velocity=task.max_velocity)
