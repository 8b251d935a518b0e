"""Environments that :func:`~torchrl_sym.mujoco.verify` can put into any state, behind one interface.

An environment is recognised by what it offers, not by its class. A batched task environment maps its full
state itself; of a dm_control `Environment` and a gymnasium `MujocoEnv` the state is that of MuJoCo, mapped
by what :func:`~torchrl_sym.mujoco.derive` finds in the model, and what they are said to remember beside.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import torch
from tensordict import NestedKey, TensorDict
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_sym._torchrl import wrapped_env
from torchrl_sym.mujoco.derive import derive
from torchrl_sym.mujoco.model.types import MjModel, mj
from torchrl_sym.mujoco.verify.remembered import Remembered
from torchrl_sym.symmetry import Symmetry

Observation: TypeAlias = dict[NestedKey, Tensor]


@dataclass(frozen=True)
class Pose:
    """Where and how `derive` looks for a symmetry; its arguments."""

    keyframe: int | str | None = None
    carried: Sequence[str] = ()


@dataclass
class PhysicsState:
    """State of one MuJoCo simulation as tensors with one row, and what its environment remembers beside."""

    qpos: Tensor
    qvel: Tensor
    mocap_pos: Tensor
    mocap_quat: Tensor
    act: Tensor
    ctrl: Tensor
    qacc_warmstart: Tensor
    time: float
    memory: dict[str, Any] = field(default_factory=dict)

    def rows(self, ids: slice) -> PhysicsState:
        """A copy."""
        copies = {name: x[ids].clone() for name, x in vars(self).items() if isinstance(x, Tensor)}
        return PhysicsState(**copies, time=self.time, memory=self.memory)


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
    """

    model: MjModel
    rows: int
    low: Tensor
    high: Tensor

    def __init__(self, symmetry: Symmetry, observe: Callable[[Any], Any] | None) -> None:
        self.symmetry = symmetry
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

    def declared(self, observation: Any) -> Observation:
        """Entries of an observation that the symmetry declares, each ``(rows, d)``."""
        observation = self.hook(observation)
        if isinstance(observation, TensorDict):
            entries = dict(observation.items(include_nested=True, leaves_only=True))
        elif isinstance(observation, Mapping):
            entries = {k: torch.as_tensor(np.array(v)).reshape(1, -1) for k, v in observation.items()}
        else:
            entries = {"observation": torch.as_tensor(np.array(observation)).reshape(1, -1)}
        if self.symmetry.strict:
            self.symmetry.require(entries, "verify")
        found: Observation = {key: x for key, x in entries.items() if key in self.symmetry}
        for key, x in found.items():
            if x.shape[-1] != self.symmetry[key].dim:
                raise ValueError(
                    f"{key!r}: the environment observes {x.shape[-1]} entries, its representation has "
                    f"{self.symmetry[key].dim}; list every entry in order"
                )
        return found


class BatchedSubject(Subject):
    """A batched task environment: `reset_to`, `state` and `task.transform_state`."""

    def __init__(
        self, env: Any, symmetry: Symmetry, observe: Callable[[Any], Any] | None, seed: int
    ) -> None:
        super().__init__(symmetry, observe)
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
        return self.declared(out.exclude(*flags))

    def state(self) -> Any:
        return self.env.state

    def load(self, state: Any) -> Observation:
        return self._observation(self.env.reset_to(state))

    def transform(self, state: Any, g: int) -> Any:
        return self.env.task.transform_state(state, g)


class PhysicsSubject(Subject):
    """One MuJoCo simulation, its state mapped through `derive`; ``owner`` is what has the memory."""

    rows = 1
    data: Any

    def __init__(
        self,
        owner: Any,
        model: MjModel,
        symmetry: Symmetry,
        observe: Callable[[Any], Any] | None,
        pose: Pose,
        memory: Remembered | None,
    ) -> None:
        super().__init__(symmetry, observe)
        self.owner, self.model, self.memory = owner, model, memory
        self.robot = derive(model, symmetry.group, pose.keyframe, carried=pose.carried)

    @abc.abstractmethod
    def observe(self) -> Observation:
        """What is observed now."""

    def state(self) -> PhysicsState:
        fields = ("qpos", "qvel", "mocap_pos", "mocap_quat", "act", "ctrl", "qacc_warmstart")
        rows = {f: torch.as_tensor(np.array(getattr(self.data, f)))[None] for f in fields}
        memory = self.memory.read(self.owner) if self.memory else {}
        return PhysicsState(**rows, time=float(self.data.time), memory=memory)

    def load(self, state: PhysicsState) -> Observation:
        write_state(self.data, state)
        mj.mj_forward(self.model, self.data)
        mj.mj_rnePostConstraint(self.model, self.data)  # contact forces, which some observe
        self.data.qacc_warmstart[:] = state.qacc_warmstart[0].numpy()  # mj_forward replaced it
        if self.memory:
            self.memory.write(self.owner, state.memory)
        return self.observe()

    def transform(self, state: PhysicsState, g: int) -> PhysicsState:
        robot = self.robot
        position, rotation = state.mocap_pos, state.mocap_quat
        if self.model.nmocap:
            position, rotation = robot.map_mocap(position, rotation, g)
        return PhysicsState(
            qpos=robot.map_qpos(state.qpos, g),
            qvel=robot.map_qvel(state.qvel, g),
            mocap_pos=position,
            mocap_quat=rotation,
            act=robot.map_act(state.act, g) if self.model.na else state.act,
            ctrl=robot.map_ctrl(state.ctrl, g) if self.model.nu else state.ctrl,
            qacc_warmstart=robot.map_qvel(state.qacc_warmstart, g),
            time=state.time,
            memory=self.memory.image(state.memory, g) if self.memory else {},
        )

    def outcome(self, reward: Any, terminated: bool, truncated: bool) -> Outcome:
        return Outcome(
            self.observe(),
            torch.tensor([float(reward or 0.0)], dtype=torch.float64),
            torch.tensor([bool(terminated)]),
            torch.tensor([bool(truncated)]),
            torch.as_tensor(np.array(self.data.ctrl))[None],
        )


class ControlSubject(PhysicsSubject):
    """A dm_control `Environment`: `physics` and `task`."""

    def __init__(
        self, env: Any, symmetry: Symmetry, observe: Any, pose: Pose, seed: int, memory: Remembered | None
    ) -> None:
        super().__init__(env, env.physics.model.ptr, symmetry, observe, pose, memory)
        self.env, self.data = env, env.physics.data.ptr
        self.substeps = round(env.control_timestep() / env.physics.timestep())
        spec = env.action_spec()
        self.low, self.high = (
            torch.as_tensor(np.array(np.broadcast_to(bound, spec.shape))).double()
            for bound in (spec.minimum, spec.maximum)
        )
        if isinstance(getattr(env.task, "random", None), np.random.RandomState):
            env.task.random.seed(seed)

    def observe(self) -> Observation:
        return self.declared(self.env.task.get_observation(self.env.physics))

    def reset(self) -> Observation:
        self.env.reset()
        return self.observe()

    def step(self, action: Tensor, active: Tensor | None = None) -> Outcome:
        task, physics = self.env.task, self.env.physics  # not env.step, which resets at time limits
        task.before_step(action[0].numpy(), physics)
        physics.step(self.substeps)
        task.after_step(physics)
        return self.outcome(task.get_reward(physics), task.get_termination(physics) is not None, False)


class GymnasiumSubject(PhysicsSubject):
    """A gymnasium `MujocoEnv`, with wrappers that map single actions, observations or rewards."""

    def __init__(
        self, env: Any, symmetry: Symmetry, observe: Any, pose: Pose, seed: int, memory: Remembered | None
    ) -> None:
        self.base = env.unwrapped
        super().__init__(self.base, self.base.model, symmetry, observe, pose, memory)
        self.data = self.base.data
        space = env.action_space
        self.low, self.high = (torch.as_tensor(np.array(x)).double() for x in (space.low, space.high))
        self.wrappers = []
        while env is not self.base:
            self.wrappers.append(env)
            env = env.env
        self.base.reset(seed=seed)

    def _apply(self, method: str, value: Any, outermost_first: bool = False) -> Any:
        for wrapper in self.wrappers if outermost_first else reversed(self.wrappers):
            value = getattr(wrapper, method)(value) if hasattr(type(wrapper), method) else value
        return value

    def observe(self) -> Observation:
        return self.declared(self._apply("observation", self.base._get_obs()))

    def reset(self) -> Observation:
        self.base.reset()
        return self.observe()

    def step(self, action: Tensor, active: Tensor | None = None) -> Outcome:
        values = self._apply("action", action[0].numpy(), outermost_first=True)
        _, reward, terminated, truncated, _ = self.base.step(values)
        return self.outcome(self._apply("reward", reward), terminated, truncated)


def write_state(data: Any, state: Any, row: int = 0) -> None:
    """Write one row of a state into an ``MjData``; what the state lacks keeps its value."""
    for name in ("qpos", "qvel", "mocap_pos", "mocap_quat", "act", "ctrl", "qacc_warmstart"):
        value = getattr(state, name, None)
        if value is not None and value[row].numel():
            getattr(data, name)[:] = value[row].numpy()
    data.time = float(torch.as_tensor(state.time).reshape(-1)[row])


def subject_of(
    env: Any, symmetry: Symmetry, observe: Any, pose: Pose, seed: int, memory: Remembered | None = None
) -> Subject:
    """The environment behind the interface, by what it offers.

    Raises:
        TypeError: an environment of another kind.
        ValueError: a pose or memory for one that maps its whole state itself.
    """
    if isinstance(env, EnvBase):
        env = wrapped_env(env)
    if not hasattr(env, "base_env"):
        if hasattr(env, "reset_to") and hasattr(getattr(env, "task", None), "transform_state"):
            if pose != Pose() or memory is not None:
                names = memory and list(memory.representations)
                raise ValueError(
                    "expected neither keyframe, carried nor memory for a batched task environment, which "
                    f"maps its state itself, got {pose.keyframe!r}, {pose.carried!r} and {names}; leave "
                    "them out, and keep what it remembers in its state"
                )
            return BatchedSubject(env, symmetry, observe, seed)
        if all(hasattr(env, name) for name in ("physics", "task", "action_spec")):
            return ControlSubject(env, symmetry, observe, pose, seed, memory)
        base = getattr(env, "unwrapped", None)
        if all(hasattr(base, name) for name in ("model", "data", "set_state", "_get_obs")):
            return GymnasiumSubject(env, symmetry, observe, pose, seed, memory)
    raise TypeError(
        "expected a batched task environment (reset_to, task.transform_state), a dm_control Environment "
        f"(physics, task) or a gymnasium MujocoEnv (model, data, set_state, _get_obs), got "
        f"{type(env).__name__}; pass the innermost environment and apply transforms with observe=..."
    )
