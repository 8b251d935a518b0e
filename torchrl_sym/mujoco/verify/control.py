"""dm_control's environments, of the suite and of composer (locomotion, manipulation)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.verify.physics import PhysicsSubject
from torchrl_sym.mujoco.verify.remembered import Remembered
from torchrl_sym.mujoco.verify.subjects import Observation, Outcome, Pose


class ControlSubject(PhysicsSubject):
    """A dm_control `Environment`: `physics` and `task`."""

    def __init__(
        self, env: Any, group: PointGroup, observe: Any, pose: Pose, seed: int, memory: Remembered | None
    ) -> None:
        self.env = env
        super().__init__(env, env.physics.model.ptr, group, observe, pose, memory)
        spec = env.action_spec()
        self.low, self.high = (
            torch.as_tensor(np.array(np.broadcast_to(bound, spec.shape))).double()
            for bound in (spec.minimum, spec.maximum)
        )
        random = getattr(env.task, "random", None) or getattr(env, "random_state", None)
        if isinstance(random, np.random.RandomState):
            random.seed(seed)

    @property
    def data(self) -> Any:
        return self.env.physics.data.ptr

    def observe(self) -> Observation:
        return self.entries(self.env.task.get_observation(self.env.physics))

    def reset(self) -> Observation:
        self.env.reset()
        return self.observe()

    def step(self, action: Tensor, active: Tensor | None = None) -> Outcome:
        task, physics = self.env.task, self.env.physics  # not env.step, which resets at time limits
        substeps = round(self.env.control_timestep() / physics.timestep())
        task.before_step(action[0].numpy(), physics)
        physics.step(substeps)
        task.after_step(physics)
        ended = task.get_termination(physics) is not None
        return self.outcome(self.observe(), task.get_reward(physics), ended, False)


class ComposerSubject(ControlSubject):
    """A composer `Environment`, whose observables may be compiled anew with every episode.

    Buffers of observables are filled with what is observed now, in a state and in its images.
    """

    def observe(self) -> Observation:
        updater = self.env._observation_updater
        updater.reset(self.env.physics, self.env.random_state)
        return self.entries(updater.get_observation())

    def reset(self) -> Observation:
        compiles = self.env._recompile_mjcf_every_episode
        self.env._recompile_mjcf_every_episode = False  # which takes longer than all that is asked here
        try:
            self.env.reset()
        finally:
            self.env._recompile_mjcf_every_episode = compiles
        model = self.env.physics.model.ptr
        if (model.nq, model.nv, model.nu, model.nbody) != (
            *(self.model.nq, self.model.nv),
            *(self.model.nu, self.model.nbody),
        ):
            raise ValueError(
                "expected the same model in every episode, got another number of joints or bodies after a "
                "reset; build the environment with recompile_mjcf_every_episode=False"
            )
        self.model = self.robot.model = model
        return self.observe()

    def step(self, action: Tensor, active: Tensor | None = None) -> Outcome:
        self.env._reset_next_step = False  # at time limits it would begin anew instead
        out = self.env.step(action[0].numpy())
        return self.outcome(self.observe(), out.reward, out.last() and out.discount == 0, False)
