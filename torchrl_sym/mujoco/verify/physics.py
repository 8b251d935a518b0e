"""Environments around one MuJoCo simulation, whose state is mapped by what `derive` finds in the model."""

from __future__ import annotations

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.derive import derive
from torchrl_sym.mujoco.model.types import MjModel, mj
from torchrl_sym.mujoco.verify.forces import Disturbances
from torchrl_sym.mujoco.verify.poses import TRIES, random_pose, reach_contact
from torchrl_sym.mujoco.verify.remembered import Remembered
from torchrl_sym.mujoco.verify.states import PhysicsState, image_of, read_state, write_state
from torchrl_sym.mujoco.verify.subjects import Observation, Outcome, Pose, Subject


class PhysicsSubject(Subject):
    """One MuJoCo simulation, its state mapped through `derive`; ``owner`` is what has the memory."""

    rows = 1
    searches = TRIES

    def __init__(
        self,
        owner: Any,
        model: MjModel,
        group: PointGroup,
        observe: Callable[[Any], Any] | None,
        pose: Pose,
        memory: Remembered | None,
    ) -> None:
        super().__init__(observe)
        self.owner, self.model, self.memory = owner, model, memory
        self.robot = derive(model, group, pose.keyframe, carried=pose.carried, axis=pose.axis)

    @property
    @abc.abstractmethod
    def data(self) -> Any:
        """The simulation's ``MjData`` now."""

    @abc.abstractmethod
    def observe(self) -> Observation:
        """What is observed now."""

    def state(self) -> PhysicsState:
        return read_state(self.data, self.memory.read(self.owner) if self.memory else {})

    def load(self, state: PhysicsState) -> Observation:
        self.put(state)
        return self.observe()

    def put(self, state: PhysicsState) -> None:
        """Continue from a state, and compute all that MuJoCo derives from it."""
        data = self.data
        write_state(data, state)
        mj.mj_forward(self.model, data)
        if self.memory:
            self.memory.write(self.owner, state.memory)
            mj.mj_forward(self.model, data)  # a target may be a place in the model
        mj.mj_rnePostConstraint(self.model, data)  # contact forces, which some observe
        data.qacc_warmstart[:] = state.qacc_warmstart[0].numpy()  # mj_forward replaced it
        Disturbances.add(data, state.added)

    def transform(self, state: PhysicsState, g: int) -> PhysicsState:
        memory = self.memory.image(state.memory, g) if self.memory else {}
        added = self.disturbances.image(state.added, g) if state.added else {}
        return image_of(self.robot, state, g, memory, added)

    @functools.cached_property
    def disturbances(self) -> Disturbances:
        """What may be added to forces and readings."""
        return Disturbances(self.robot)

    def disturb(self, state: PhysicsState, generator: torch.Generator) -> PhysicsState:
        return dataclasses.replace(state, added=self.disturbances.draw(generator))

    def probe(self, generator: torch.Generator) -> tuple[Observation, Observation]:
        self.reset()
        state = self.state()
        plain = self.begin(state)
        return plain, self.begin(
            dataclasses.replace(state, added=Disturbances.anything(self.model, generator))
        )

    def map_ctrl(self, ctrl: Tensor, g: int) -> Tensor | None:
        return self.robot.map_ctrl(ctrl, g) if self.model.nu else None

    def vary(self, state: PhysicsState, generator: torch.Generator, number: int) -> PhysicsState:
        return random_pose(self.model, state, generator, number)

    def touching(self, generator: torch.Generator) -> PhysicsState | None:
        return reach_contact(self.model, self.state(), generator)

    def outcome(self, observation: Observation, reward: Any, terminated: Any, truncated: Any) -> Outcome:
        return Outcome(
            observation,
            torch.tensor([float(reward or 0.0)], dtype=torch.float64),
            torch.tensor([bool(terminated)]),
            torch.tensor([bool(truncated)]),
            torch.as_tensor(np.array(self.data.ctrl))[None],
        )
