"""What users hand to an environment: taken exactly as it is, or refused.

Actions, masks of rows, start states, saved states. An error says what was expected, what came and
what to do, before anything has changed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from tasks.state import State


def action_of(tensordict: TensorDictBase, shape: torch.Size, device: torch.device) -> Tensor:
    """The actions of a step, of floating point and of this shape, on a device and without gradient.

    Raises:
        KeyError: there are none.
        TypeError: not a tensor of real floating-point numbers.
        ValueError: another shape.
    """
    action: Any = tensordict.get("action", None)
    if action is None:
        raise KeyError(
            f"expected 'action' of shape {tuple(shape)} beside {sorted(map(str, tensordict.keys()))}, got "
            "none; let a policy write it, or env.rand_action(tensordict)"
        )
    if not isinstance(action, Tensor) or not action.is_floating_point():
        kind = action.dtype if isinstance(action, Tensor) else type(action).__name__
        raise TypeError(
            f"action: expected a tensor of floating-point numbers, got {kind}; use action.float()"
        )
    if action.shape != shape:  # arithmetic would broadcast it
        raise ValueError(
            f"action: expected shape {tuple(shape)} (num_envs, action_size), got {tuple(action.shape)}; "
            "check the policy's last layer"
        )
    if action.requires_grad or action.device != device:
        action = action.detach().to(device)
    return action


def rows_of(name: str, mask: Tensor, num_envs: int, device: torch.device) -> Tensor:
    """A mask of rows as ``(num_envs,)`` bool on a device.

    Raises:
        ValueError: another shape or type.
    """
    if mask.dtype != torch.bool or mask.shape not in ((num_envs,), (num_envs, 1)):
        raise ValueError(
            f"{name}: expected a bool mask of shape ({num_envs}, 1), one per simulation, got {mask.dtype} "
            f"of shape {tuple(mask.shape)}"
        )
    return mask.reshape(-1).to(device)


def check_start(start: State, own: Mapping[str, Tensor], rows: int, *, finite: bool = True) -> None:
    """Refuse a start whose time or task variables would be kept, broadcast or spread silently.

    Positions and velocities are checked where they are written (``Simulation.write``).

    Args:
        start: what an episode is to start from.
        own: the variables of the task, ``(n, ...)`` each.
        rows: how many rows are started.
        finite: look at the numbers too, for which a device is waited for.

    Raises:
        TypeError: not a :class:`~tasks.state.State`.
        ValueError: the number of rows, the names, a shape, or a number that is not finite.
    """
    if not isinstance(start, State):
        raise TypeError(
            f"expected a tasks.state.State, got {type(start).__name__}; take env.state or "
            "env.task.sample_goal_state(n, generator)"
        )
    if len(start) != rows:
        raise ValueError(f"expected a state of {rows} rows, one per simulation, got {len(start)}")
    if start.variables.keys() != own.keys():
        raise ValueError(
            f"expected a state with the task's variables {sorted(own)}, got {sorted(start.variables)}; "
            "start from env.state or env.task.sample_goal_state(n, generator)"
        )
    for name, value in start.variables.items():
        expected = (rows, *own[name].shape[1:])
        alike = isinstance(value, Tensor) and value.shape == expected
        if not alike or (finite and not bool(value.isfinite().all())):
            shape = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
            raise ValueError(
                f"expected a finite tensor of shape {expected} for the variable {name!r}, got {shape}, or "
                "numbers that are not finite; check how the start states are made"
            )
    if finite and start.time is not None and bool((start.time < 0).any()):
        raise ValueError(
            f"expected a time of at least 0 s since the episode began, got {float(start.time.min())} s; "
            "leave it out for an episode that begins"
        )


def check_saved(saved: Any, own: Any, name: str = "saved") -> None:
    """Refuse what is not like ``own``: the same keys, types, shapes and words, and finite numbers.

    Args:
        saved: nested dictionaries of tensors and numbers.
        own: the same of the one that is to continue from it.
        name: of what is compared.

    Raises:
        ValueError: names the first difference.

    Example:
        >>> check_saved({"over": torch.zeros(3)}, {"over": torch.zeros(4)})
        Traceback (most recent call last):
        ...
        ValueError: expected saved over of shape (4,) and torch.float32, got (3,) and torch.float32...
    """
    hint = "; restore what save_state() of an environment made alike returned"
    if type(saved) is not type(own):
        raise ValueError(f"expected {name} to be a {type(own).__name__}, got {type(saved).__name__}{hint}")
    if isinstance(own, dict):
        if saved.keys() != own.keys():
            raise ValueError(f"expected {name} with {sorted(own)}, got {sorted(map(str, saved))}{hint}")
        for key, value in own.items():
            check_saved(saved[key], value, f"{name} {key}")
    elif isinstance(own, str) and saved != own:
        raise ValueError(f"expected {name} {own!r}, got {saved!r}{hint}")
    elif isinstance(own, Tensor):
        expected, got = (f"{tuple(x.shape)} and {x.dtype}" for x in (own, saved))
        if expected != got:
            raise ValueError(f"expected {name} of shape {expected}, got {got}{hint}")
        if not bool(saved.isfinite().all()):
            raise ValueError(
                f"expected finite {name}, got {int((~saved.isfinite()).sum())} other numbers{hint}"
            )
