"""Our own batched task environments, which map their whole state themselves."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_sym.mujoco.verify.poses import random_pose
from torchrl_sym.mujoco.verify.states import physics_states
from torchrl_sym.mujoco.verify.subjects import Observation, Outcome, Subject


class BatchedSubject(Subject):
    """A batched task environment: `reset_to`, `state` and `task.transform_state`."""

    whole = True

    def __init__(self, env: Any, observe: Callable[[Any], Any] | None, seed: int) -> None:
        super().__init__(observe)
        self.env, self.model, self.rows = env, env.task.model, env.batch_size[0]
        self.low, self.high = (x[0].double().cpu() for x in (env.action_spec.low, env.action_spec.high))
        env.set_seed(seed)

    def reset(self) -> Observation:
        return self._observation(self.env.reset())

    def step(self, action: Tensor, active: Tensor | None = None) -> Outcome:
        batch = TensorDict({"action": action}, batch_size=[self.rows])
        if active is not None:
            batch["_step"] = active[:, None]
        out = self.env._step(batch)  # not `step`, which may refuse rows that have ended
        reward, terminated, truncated = (out[k].reshape(-1) for k in ("reward", "terminated", "truncated"))
        ctrl = self.env.simulation.ctrl.clone()
        return Outcome(self._observation(out), reward, terminated, truncated, ctrl)

    def _observation(self, out: Any) -> Observation:
        flags = ("reward", "done", "terminated", "truncated")
        return self.entries(out.exclude(*flags))

    def state(self) -> Any:
        return self.env.state

    def load(self, state: Any) -> Observation:
        return self._observation(self.env.reset_to(state))

    def transform(self, state: Any, g: int) -> Any:
        return self.env.task.transform_state(state, g)

    def vary(self, state: Any, generator: torch.Generator, number: int) -> Any:
        poses = [
            random_pose(self.model, row, generator, number) for row in physics_states(self.model, state)
        ]
        qpos, qvel = (torch.cat([getattr(pose, x) for pose in poses]) for x in ("qpos", "qvel"))
        return dataclasses.replace(state, qpos=qpos, qvel=qvel)

    def map_ctrl(self, ctrl: Tensor, g: int) -> Tensor | None:
        robot = getattr(self.env.task, "robot", None)
        return None if robot is None else robot.map_ctrl(ctrl, g)
