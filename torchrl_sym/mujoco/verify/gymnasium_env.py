"""gymnasium's environments around MuJoCo, with any wrappers."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.verify.physics import PhysicsSubject
from torchrl_sym.mujoco.verify.remembered import Remembered
from torchrl_sym.mujoco.verify.states import PhysicsState
from torchrl_sym.mujoco.verify.subjects import Observation, Outcome, Pose

# gymnasium's wrappers that make an observation of more than one.
_REMEMBERING = (
    "FrameStackObservation",
    "DelayObservation",
    "TimeAwareObservation",
    "MaxAndSkipObservation",
)


class GymnasiumSubject(PhysicsSubject):
    """A gymnasium environment that has `model`, `data` and `_get_obs`, with wrappers.

    A single state is observed through those wrappers that map single actions, observations or rewards.
    An episode (`begin`, `advance`) goes through all of them, also those that remember: the innermost
    environment is made to begin, and to go on, in the states asked for.
    """

    def __init__(
        self, env: Any, group: PointGroup, observe: Any, pose: Pose, seed: int, memory: Remembered | None
    ) -> None:
        self.env, self.base = env, env.unwrapped
        super().__init__(self.base, self.base.model, group, observe, pose, memory)
        space = env.action_space
        if not (hasattr(space, "low") and hasattr(space, "high")):
            raise TypeError(
                f"expected a box of actions, got {space}; for discrete actions declare the representation "
                "of the one-hot action, e.g. permutation(group, names, maps)"
            )
        self.low, self.high = (torch.as_tensor(np.array(x)).double() for x in (space.low, space.high))
        self.wrappers = []
        while env is not self.base:
            self.wrappers.append(env)
            env = env.env
        kept = [type(w).__name__ for w in self.wrappers if type(w).__name__ in _REMEMBERING]
        if kept:
            self.hint = f"; single states do not go through {kept[0]}, which remembers: take what is inside"
        self.base.reset(seed=seed)

    @property
    def data(self) -> Any:
        return self.base.data

    def _apply(self, method: str, value: Any, outermost_first: bool = False) -> Any:
        for wrapper in self.wrappers if outermost_first else reversed(self.wrappers):
            value = getattr(wrapper, method)(value) if hasattr(type(wrapper), method) else value
        return value

    def observe(self) -> Observation:
        return self.entries(self._apply("observation", observed(self.base)))

    def reset(self) -> Observation:
        self.base.reset()
        return self.observe()

    def step(self, action: Tensor, active: Tensor | None = None) -> Outcome:
        values = self._apply("action", self._shaped(action), outermost_first=True)
        _, reward, terminated, truncated, _ = self.base.step(values)
        return self.outcome(self.observe(), self._apply("reward", reward), terminated, truncated)

    def begin(self, state: PhysicsState) -> Observation:
        inner = self.base.reset

        def reset(**kwargs: Any) -> tuple[Any, dict[str, Any]]:
            _, info = inner(**kwargs)
            self.put(state)
            return observed(self.base), info

        return self.entries(self._through("reset", reset, lambda: self.env.reset())[0])

    def advance(self, action: Tensor, state: PhysicsState) -> Observation:
        inner = self.base.step

        def step(values: Any) -> tuple[Any, ...]:
            _, *rest = inner(values)
            self.put(state)
            return observed(self.base), *rest

        return self.entries(self._through("step", step, lambda: self.env.step(self._shaped(action)))[0])

    def _through(self, name: str, inside: Any, call: Any) -> Any:
        """Call the outermost wrapper while the innermost environment does something of its own."""
        setattr(self.base, name, inside)
        try:
            return call()
        finally:
            delattr(self.base, name)

    def _shaped(self, action: Tensor) -> Any:
        return action[0].numpy().reshape(self.env.action_space.shape)


def observed(env: Any) -> Any:
    """What an environment observes now; some (mazes) make it of what the robot inside them observes."""
    needed = [
        p
        for p in inspect.signature(env._get_obs).parameters.values()
        if p.default is p.empty and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    ]
    if not needed:
        observation = env._get_obs()
    else:
        inside = [x for x in vars(env).values() if hasattr(x, "_get_obs") and hasattr(x, "data")]
        if len(needed) > 1 or len(inside) != 1:
            raise TypeError(
                f"expected _get_obs() without arguments, got {[p.name for p in needed]} in "
                f"{type(env).__name__}; give the environment a _get_obs() that needs none"
            )
        observation = env._get_obs(observed(inside[0]))
    return observation[0] if isinstance(observation, tuple) else observation
