"""What :func:`~torchrl_sym.mujoco.verify` and :func:`~torchrl_sym.mujoco.infer` ask of an environment.

Whatever it is, it can be put into a state s and into the image L_g s, says what it observes there, and is
stepped from there. What it remembers beside (last actions, a history) begins anew with an episode, so that
an episode of mirrored actions from a mirrored start reaches the image of it.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import unravel_key
from torch import Tensor

from torchrl_sym import checks
from torchrl_sym.mujoco.model.types import MjModel

Observation: TypeAlias = dict[NestedKey, Tensor]


@dataclass(frozen=True)
class Pose:
    """Where and how `derive` looks for a symmetry; its arguments."""

    keyframe: int | str | None = None
    axis: tuple[float, float] | None = None
    carried: Sequence[str] = ()


@dataclass
class Outcome:
    """What one step of an environment returned, a row per simulation; ``ctrl`` is what it applied."""

    observation: Observation
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    ctrl: Tensor


class Subject(abc.ABC):
    """An environment under test: some rows of simulations that can be put into any state.

    Attributes:
        model: the MuJoCo model.
        rows: number of simulations that step together.
        low: smallest action, ``(actions,)``; ``high`` likewise.
        hint: what else may be wrong if sizes do not fit.
        whole: whether the state holds all that is remembered.
        searches: how many poses :meth:`touching` tries.
    """

    model: MjModel
    rows: int
    low: Tensor
    high: Tensor
    hint = ""
    whole = False
    searches = 0

    def __init__(self, observe: Callable[[Any], Any] | None) -> None:
        self.hook = observe or (lambda observation: observation)

    @abc.abstractmethod
    def reset(self) -> Observation:
        """Start new episodes."""

    @abc.abstractmethod
    def step(self, action: Tensor, active: Tensor | None = None) -> Outcome:
        """Apply actions ``(rows, actions)``, to the ``active`` rows only."""

    @abc.abstractmethod
    def state(self) -> Any:
        """A copy of the state."""

    @abc.abstractmethod
    def load(self, state: Any) -> Observation:
        """Continue from a state; what is observed there."""

    @abc.abstractmethod
    def transform(self, state: Any, g: int) -> Any:
        """Image of a state."""

    @abc.abstractmethod
    def map_ctrl(self, ctrl: Tensor, g: int) -> Tensor | None:
        """Image of controls ``(..., nu)``; None if nobody knows."""

    def begin(self, state: Any) -> Observation:
        """Start new episodes in a state: all that is remembered beside it is as at any start."""
        self.reset()
        return self.load(state)

    def advance(self, action: Tensor, state: Any) -> Observation:
        """Step, so that what is remembered follows; then go on from a state."""
        self.step(action)
        return self.load(state)

    def vary(self, state: Any, generator: torch.Generator, number: int) -> Any:
        """Another state to begin in; this one, where starts are varied enough."""
        return state

    def disturb(self, state: Any, generator: torch.Generator) -> Any:
        """The same state, observed as if there were other contact forces, if they can be had."""
        return state

    def probe(self, generator: torch.Generator) -> tuple[Observation, Observation] | None:
        """What is observed in a state, and there with other contact forces and sensor readings."""
        return None

    def touching(self, generator: torch.Generator) -> Any | None:
        """A state in which something touches, if one is easily found."""
        return None

    def entries(self, observation: Any) -> Observation:
        """All that is observed, by key, each ``(rows, ...)``; one number is ``(rows, 1)``.

        Raises:
            TypeError: something other than numbers.
        """
        observation = self.hook(observation)
        if isinstance(observation, TensorDictBase):
            return dict(observation.items(include_nested=True, leaves_only=True))
        if not isinstance(observation, Mapping):
            return {"observation": _row("observation", observation)}
        return {unravel_key(key): _row(unravel_key(key), x) for key, x in _leaves(observation, ())}


def _leaves(observation: Mapping[str, Any], above: tuple[str, ...]) -> list[tuple[tuple[str, ...], Any]]:
    found = []
    for name, value in observation.items():
        inside = isinstance(value, Mapping)
        found += _leaves(value, (*above, name)) if inside else [((*above, name), value)]
    return found


def _row(key: NestedKey, value: Any) -> Tensor:
    if isinstance(value, Tensor):
        x = value.detach().cpu()
    else:
        array = np.array(value)
        if array.dtype.kind not in "biuf":
            raise TypeError(
                f"{key!r}: expected an array of numbers, got {checks.shown(value)}; leave it out, or turn "
                "it into numbers with observe=..."
            )
        x = torch.as_tensor(array)
    return x.reshape(1, *x.shape) if x.ndim else x.reshape(1, 1)
