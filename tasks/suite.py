"""The dm_control face of a task: one simulation as a `dm_control.rl.control.Environment`.

The same description as in the batched face, called with one row: `Physics` holds the same compiled
model, the dm_control task hands its state over as a `State` and passes on what the description
returns. Use it with TorchRL's `DMControlWrapper`, with dm_control's viewer, or with anything that
speaks dm_env.
"""

from __future__ import annotations

import collections
import copy
from typing import Any

import mujoco as engine
import numpy as np
import torch
from dm_control import mujoco
from dm_control.mujoco import wrapper
from dm_control.rl import control
from dm_control.rl.control import PhysicsError
from dm_env import specs
from torch import Tensor

from tasks.base import Task, create
from tasks.processes import Generator
from tasks.state import State
from torchrl_sym import checks

mj: Any = engine  # its compiled modules have no type stubs


class Physics(mujoco.Physics):
    """dm_control's physics, which pickled or copied continues exactly."""

    legacy_step = False  # an instance's own value is not pickled

    def __setstate__(self, data: wrapper.MjData) -> None:
        whole = copy.copy(data.ptr)
        super().__setstate__(data)  # runs the solver, which forgets its warm start
        mj.mj_copyData(data.ptr, data.model.ptr, whole)


class OneSimulation:
    """The model of one simulation, written to as if it were a batch of one (`Simulation.expand`)."""

    def __init__(self, model: Any) -> None:
        self._model = model

    def expand(self, name: str) -> Tensor:
        """Live values of a model field, ``(1, ...)``."""
        return torch.from_numpy(getattr(self._model, name))[None]

    def refresh(self, ids: Tensor | None = None) -> None:
        """Recompute the constants that MuJoCo derives from written fields."""
        mj.mj_setConst(self._model, mj.MjData(self._model))


class SuiteTask(control.Task):
    """A task description as a dm_control task.

    A simulation that diverges raises dm_control's ``PhysicsError``, and so does an action that is not
    finite: nothing has been stepped then, and the next episode may be reset. (One row of the batched face
    ends instead, with reward 0.)

    Args:
        description: the task.
        random: seed or random state of the start states, as everywhere in dm_control.

    Attributes:
        description: the task.
    """

    def __init__(self, description: Task, random: int | np.random.RandomState | None = None) -> None:
        if not isinstance(random, np.random.RandomState):
            seed = None if random is None else checks.whole("random", random, 0, 2**32 - 1)
            random = np.random.RandomState(seed)
        self.description = checks.instance("description", description, Task, "tasks.base.create makes one")
        description.check_observation(description.sample_initial_state(1, torch.Generator()))
        self._generator = Generator().manual_seed(int(random.randint(2**31)))
        self._state: State | None = None
        self._fresh = True
        self._reward = 0.0
        self._action = torch.zeros(1, description.action_size, dtype=torch.float64)

    @property
    def state(self) -> State:
        """A copy of the current state, one row.

        Raises:
            RuntimeError: before the first reset.
        """
        if self._state is None:
            raise RuntimeError("expected a started episode, got none; call reset() first")
        return self._state.clone()

    def initialize_episode(self, physics: mujoco.Physics) -> None:
        if self._state is None:
            start = self.description.sample_initial_state(1, self._generator)
        else:
            start = self.description.restart(self._state, self._generator)
        one: Any = OneSimulation(physics.model.ptr)  # all that `randomize` needs of a Simulation
        self.description.randomize(one, torch.zeros(1, dtype=torch.int64), self._generator)
        self._state = start.clone()
        self._fresh = True
        physics.data.time = float(start.time)
        for field in ("qpos", "qvel", "mocap_pos", "mocap_quat"):
            value = getattr(start, field)
            if value is not None:
                getattr(physics.data, field)[:] = value[0].numpy()

    def before_step(self, action: np.ndarray, physics: mujoco.Physics) -> None:
        if self._fresh:  # dm_control's reset ran the solver; a batched row starts without memory
            physics.data.qacc_warmstart[:] = 0.0
            self._fresh = False
        self._action = _action(action, self.description.action_size)
        ctrl = self.description.control(self._action, self._current(physics))
        physics.set_control(ctrl[0].numpy())

    def after_step(self, physics: mujoco.Physics) -> None:
        state = self._current(physics)
        self._reward = float(self.description.reward(state, self._action))
        state.variables |= self.description.update(state, self._action)

    # dm_control's base class has no return annotations; `Any` keeps type checkers quiet about it.
    def get_reward(self, physics: mujoco.Physics) -> Any:
        return self._reward

    def get_observation(self, physics: mujoco.Physics) -> Any:
        observation = self.description.observe(self._current(physics))[0]
        return collections.OrderedDict(observation=observation.to(torch.float64).numpy())

    def get_termination(self, physics: mujoco.Physics) -> Any:
        terminated = self.description.terminated(self._current(physics))
        over = terminated is not None and bool(terminated)
        return 0.0 if over else None  # the discount of an episode that ends here

    def action_spec(self, physics: mujoco.Physics) -> Any:
        return specs.BoundedArray((self.description.action_size,), np.float64, -1.0, 1.0, "action")

    def _current(self, physics: mujoco.Physics) -> State:
        """The state with the physics' present positions and velocities."""
        state = self._state
        if state is None:  # asked for a spec before the first reset
            state = self.description.sample_initial_state(1, torch.Generator())
        state.qpos = _row(physics.data.qpos)
        state.qvel = _row(physics.data.qvel)
        state.time = _row(physics.data.time)
        state.mocap_pos = _row(physics.data.mocap_pos)
        state.mocap_quat = _row(physics.data.mocap_quat)
        return state


def _action(action: Any, size: int) -> Tensor:
    values = np.asarray(action)
    if values.shape != (size,) or values.dtype.kind not in "fiu":  # reshaped or broadcast, it would pass
        raise ValueError(
            f"action: expected {size} real numbers of shape ({size},), got {values.dtype} of shape "
            f"{values.shape}; see env.action_spec()"
        )
    if not np.isfinite(values).all():
        raise PhysicsError(
            f"action: expected finite numbers, got {values}; check the policy, and reset the environment"
        )
    return torch.as_tensor(values, dtype=torch.float64)[None]


def _row(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.array(values, dtype=np.float64))[None]


def load(
    name: str, random: int | np.random.RandomState | None = None, **task_kwargs: Any
) -> control.Environment:
    """dm_control environment of a task, by name: one simulation, float64 observations.

    Args:
        name: one of ``tasks.ALL_TASKS``.
        random: seed or random state of the start states.
        **task_kwargs: arguments of the task, such as ``episode_seconds``.

    Raises:
        KeyError: no such task; the message lists the names.
        TypeError: an argument that the task does not take.

    Example:
        >>> import tasks
        >>> env = tasks.load("cartpole", random=0)
        >>> env.reset().observation["observation"].shape, env.control_timestep()
        ((3,), 0.02)
    """
    description = create(name, **task_kwargs)
    # A copy: the model's fields are drawn anew for every episode of a randomised task.
    physics = Physics.from_model(wrapper.MjModel(copy.copy(description.model)))
    return control.Environment(
        physics,
        SuiteTask(description, random),
        # Half a step less: dm_control compares a step count with a quotient of floats.
        time_limit=(description.max_steps - 0.5) * description.control_timestep,
        n_sub_steps=description.substeps,
        legacy_step=False,  # mj_step as in the batch, not dm_control's split into two halves
    )
