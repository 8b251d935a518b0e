"""The batched TorchRL face of a task: n simulations as one environment.

`BatchedEnv` ties a task's description to a `Simulation` and meets TorchRL's contract for batched
environments: it never resets itself (the true last observation of an episode is under "next", so
that time-outs can be bootstrapped), resets any subset of rows, and can be saved and continued bit
for bit.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from tasks.base import Task, create
from tasks.checks import action_of, check_saved, check_start, rows_of
from tasks.processes import Generator, by_value, from_value
from tasks.simulation import Simulation
from tasks.state import State
from torchrl_sym import checks

MAX_SEED = 2**63 - 1


class BatchedEnv(EnvBase):
    """n simulations of one task as a TorchRL environment of batch size ``[n]``.

    Keys: ``"observation"`` (n, observation_size) float32; ``"action"`` (n, action_size) float32 in
    [-1, 1], clipped; ``"reward"``, ``"done"``, ``"terminated"``, ``"truncated"`` (n, 1). An episode
    is truncated after ``task.max_steps`` steps and terminated where the task says so.

    A row whose simulation diverges, or whose action is not finite (NaN or infinite), is terminated with
    reward 0 and counted in ``num_diverged``; its observation is that of the model's reference
    configuration. The other rows are not affected.

    Pickled or copied (``copy.deepcopy``) it continues exactly: state, generator, curriculum. In a forked
    child its physics threads do not exist, and stepping it is an error, unless ``num_threads`` is 1.

    Args:
        task: the description.
        num_envs: number of simulations n.
        num_threads: physics threads, 0 for all cores; does not change the results.
        seed: seed of all start states. Defaults to a draw from torch's global generator.
        device: where tensors go; the physics runs on the CPU. Defaults to the CPU.

    Attributes:
        task: the description.
        symmetry: the task's :class:`~torchrl_sym.Symmetry`.
        simulation: the physics.
        num_diverged: simulations that diverged since construction.

    Raises:
        TypeError: not a task, or a number of another type.
        ValueError: a number out of range, or a task that contradicts itself.

    Example:
        >>> from tasks.base import create
        >>> env = BatchedEnv(create("cartpole"), num_envs=4, num_threads=1, seed=0)
        >>> env.rollout(10)["next", "observation"].shape
        torch.Size([4, 10, 3])
    """

    def __init__(
        self,
        task: Task,
        num_envs: int,
        *,
        num_threads: int = 2,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        if not isinstance(task, Task):
            raise TypeError(
                f"expected a task, got {type(task).__name__}; tasks.make_env takes a task's name"
            )
        if seed is not None:  # before the physics is made
            seed = checks.whole("seed", seed, 0, MAX_SEED)
        simulation = Simulation(task.model, num_envs, num_threads, max_velocity=task.max_velocity)
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.task = task
        self.simulation = simulation
        self.num_diverged = 0
        self._generator = Generator()
        self._make_specs()
        self._substeps = task.substeps
        # Time adds up rounding errors; half a control step is far above them.
        self._time_limit = (task.max_steps - 0.5) * task.control_timestep
        start = task.sample_initial_state(1, torch.Generator().manual_seed(0))
        self._check_task(start)
        variables = {name: x.new_zeros(num_envs, *x.shape[1:]) for name, x in start.variables.items()}
        self._state = self._state_with(variables)
        self._over = torch.zeros(num_envs, dtype=torch.bool)  # rows whose episode has ended
        self._started = False
        self._restored = False
        self._stagger = False
        self.set_seed(seed if seed is not None else int(torch.randint(2**31, ())))

    def _state_with(self, variables: dict[str, Tensor]) -> State:
        """The state of all rows; its positions and velocities are the simulation's own memory."""
        physics = self.simulation
        parts = (physics.qpos, physics.qvel, physics.mocap_pos, physics.mocap_quat, physics.time)
        return State(*parts, variables=variables)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_state": by_value(self._state.variables)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._state = self._state_with(from_value(state["_state"]))

    @property
    def symmetry(self):
        """How the task's group acts on observation and action."""
        return self.task.symmetry

    @property
    def state(self) -> State:
        """A copy of the full state of all rows."""
        return self._state.clone()

    def _make_specs(self) -> None:
        (n,) = self.batch_size
        task = self.task

        real: dict[str, Any] = {"dtype": torch.float32, "device": self.device}

        def flag() -> Binary:
            return Binary(1, shape=torch.Size((n, 1)), dtype=torch.bool, device=self.device)

        self.observation_spec = Composite(
            observation=Unbounded(torch.Size((n, task.observation_size)), **real), shape=(n,)
        )
        self._action_shape = torch.Size((n, task.action_size))
        self.action_spec = Bounded(-1.0, 1.0, shape=self._action_shape, **real)
        self.reward_spec = Unbounded(torch.Size((n, 1)), **real)
        self.full_done_spec = Composite(done=flag(), terminated=flag(), truncated=flag(), shape=(n,))

    def _check_task(self, start: State) -> None:
        """Sizes, boxes and goals agree with the symmetry: better now than after a night's training."""
        group, names = self.task.symmetry.group, self.task.goal_names
        if len(names) != group.order:
            raise ValueError(
                f"expected one goal name per group element {list(group.names)}, got {list(names)}; "
                f"correct goal_names of task {self.task.name!r}"
            )
        self.task.symmetry.check_specs(self)
        self.task.check_observation(start)

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            self._generator.seed()
        else:
            self._generator.manual_seed(checks.whole("seed", seed, 0, MAX_SEED))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not self._started:
            raise RuntimeError("expected a started episode, got none; call reset() first")
        self._restored = False
        task, state, simulation = self.task, self._state, self.simulation
        action = action_of(tensordict, self._action_shape)
        lost = None
        if not math.isfinite(float(action.sum())):
            lost = ~action.isfinite().all(dim=-1, keepdim=True)
            action = action.masked_fill(lost, 0.0)
        ctrl = task.control(action, state)
        if lost is not None:
            ctrl = ctrl.masked_fill(lost, math.nan)  # which the simulation reports
        active = tensordict.get("_step", None)  # TorchRL skips rows that are done in some rollouts
        if active is not None:
            active = rows_of("_step", active, len(state))
        diverged = None
        if simulation.step(ctrl, self._substeps, active):
            diverged = simulation.diverged()
            self.num_diverged += int(diverged.sum())
            action = action.masked_fill(diverged[:, None], 0.0)
        state.hold()
        reward = task.reward(state, action)
        for name, value in task.update(state, action).items():
            rows = slice(None) if active is None else active
            state.variables[name][rows] = value[rows].to(state.variables[name].dtype)
        truncated = state.time > self._time_limit
        terminated = task.terminated(state)
        if diverged is not None:
            reward = reward.masked_fill(diverged, 0.0)
            terminated = diverged if terminated is None else terminated | diverged
        over = truncated if terminated is None else terminated | truncated
        self._over = over if active is None else torch.where(active, over, self._over)
        if terminated is None:
            terminated = torch.zeros_like(truncated)
        observation = task.observe(state)
        state.release()
        return self._output(
            observation=observation.to(torch.float32),
            reward=reward.to(torch.float32).unsqueeze(-1),
            done=self._over.unsqueeze(-1).clone(),  # truncated is another tensor
            terminated=terminated.unsqueeze(-1),
            truncated=truncated.unsqueeze(-1),
        )

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        # TorchRL completes shapes and flags here; ours are complete, and it costs as much as _step.
        return next_tensordict_out

    def _output(self, **entries: Tensor) -> TensorDict:
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = torch.ones_like(self._over) if mask is None else rows_of("_reset", mask, len(self._over))
        if self._restored and bool(rows.all()):
            rows = self._over.clone()  # continue: only episodes that had ended when saved begin anew
        self._restored = False
        ids = rows.nonzero().squeeze(-1)
        if len(ids):
            if self._started:
                start = self.task.restart(self._state.rows(ids), self._generator)
            else:
                start = self.task.sample_initial_state(len(ids), self._generator)
            self._write(ids, start)
            self.task.randomize(self.simulation, ids, self._generator)
        if self._stagger and len(ids) == len(rows):
            self._stagger = False
            steps = torch.randint(self.task.max_steps, rows.shape, generator=self._generator)
            self._state.time[:] = steps * self.task.control_timestep
        return self._first_output()

    def stagger(self) -> None:
        """Start every row of the next full reset at a random time of its episode.

        Otherwise episodes that end by time alone stay in step, every batch of a collector sees one
        phase of the task, and on-policy learning forgets the others.

        Example:
            >>> import tasks
            >>> env = tasks.make_env("cartpole", num_envs=64, num_threads=1, seed=0)
            >>> env.stagger()
            >>> start = env.reset()
            >>> len(set(env.state.time.tolist())) > 32
            True
        """
        self._stagger = True

    def reset_to(self, state: State) -> TensorDict:
        """Start an episode of every row from a given state, as for evaluation.

        Args:
            state: n rows; ``state.time`` counts towards the time limit.

        Returns:
            What :meth:`reset` returns.

        Raises:
            TypeError: not a state.
            ValueError: a wrong number of rows, a state that is not finite, or other variables than the
                task's.

        Example:
            >>> import tasks, torch
            >>> env = tasks.make_env("cartpole", num_envs=2, num_threads=1)
            >>> start = env.task.sample_goal_state(2, torch.Generator().manual_seed(0))
            >>> left = env.reset_to(env.task.transform_state(start, "reflect-x"))
            >>> bool((left["observation"] == -env.reset_to(start)["observation"]).all())
            True
        """
        self._write(torch.arange(*self.batch_size), state)
        self._restored = False
        return self._first_output()

    def _write(self, ids: Tensor, start: State) -> None:
        own = self._state.variables
        check_start(start, own, len(ids))
        self.simulation.write(ids, start.qpos, start.qvel, start.mocap_pos, start.mocap_quat, start.time)
        for name, value in start.variables.items():
            own[name][ids] = value.to(own[name].dtype)
        self._started = True
        self._over = self._over.index_fill(0, ids, False)  # not in place: outputs may share it

    def _first_output(self) -> TensorDict:
        flags = torch.zeros(3, *self.batch_size, 1, dtype=torch.bool)
        self._state.release()
        return self._output(
            observation=self.task.observe(self._state).to(torch.float32),
            done=flags[0],
            terminated=flags[1],
            truncated=flags[2],
        )

    def metrics(self) -> dict[str, float]:
        """How training goes: what the task measures, and how the simulations fare.

        Success, level and the like are the task's; ``diverged`` counts simulations from the start,
        ``physics_seconds`` is the time spent in them since the last call.
        """
        seconds, self.simulation.seconds = self.simulation.seconds, 0.0
        own = {"diverged": float(self.num_diverged), "physics_seconds": seconds}
        return own | self.task.metrics()

    def description(self) -> dict[str, Any]:
        """Which task this is, with its arguments: a run is not continued in another one."""
        return {"task": self.task.name, **self.task.arguments}

    def save_state(self) -> dict[str, Any]:
        """Everything that decides the future of this environment, as copied tensors.

        Physics rows (time included), task variables, random generator and curriculum. The dictionary
        can be stored with ``torch.save`` and read with ``weights_only=True``.
        """
        return {
            "task_name": self.task.name,
            "simulation": self.simulation.save(),
            "variables": {name: x.clone() for name, x in self._state.variables.items()},
            "over": self._over.clone(),
            "started": self._started,
            "generator": self._generator.get_state(),
            "num_diverged": self.num_diverged,
            "task": self.task.state_dict(),
        }

    def restore_state(self, saved: dict[str, Any]) -> None:
        """Continue exactly where :meth:`save_state` was called.

        The next full ``reset()`` returns the observation of the restored state instead of drawing
        new starts (rows whose episode had just ended begin anew, as they would have): a collector,
        which begins by a reset, therefore continues the interrupted episodes. Later resets are
        ordinary.

        Raises:
            ValueError: the state belongs to another task or number of simulations.

        Example:
            >>> import tasks
            >>> env = tasks.make_env("cartpole", num_envs=2, num_threads=1, seed=0)
            >>> last = env.rollout(5)["next", "observation"][:, -1]
            >>> other = tasks.make_env("cartpole", num_envs=2, num_threads=1, seed=1)
            >>> other.restore_state(env.save_state())
            >>> bool((other.reset()["observation"] == last).all())
            True
        """
        self._check_saved(saved)
        try:
            self._generator.set_state(saved["generator"])
            self.task.load_state_dict(saved["task"])
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
            raise ValueError(
                f"expected the saved generator and what task {self.task.name!r} saves, got something else "
                f"({type(error).__name__}: {error}); restore what save_state() returned"
            ) from error
        self.simulation.load(saved["simulation"])
        self._state.variables = {name: x.clone() for name, x in saved["variables"].items()}
        self._over = saved["over"].clone()
        self._started = saved["started"]
        self.num_diverged = saved["num_diverged"]
        self._restored = self._started

    def _check_saved(self, saved: Any) -> None:
        own = self.save_state()
        if isinstance(saved, dict):  # the simulation and the task look at theirs themselves
            own |= {key: saved[key] for key in ("simulation", "task") if isinstance(saved.get(key), dict)}
        check_saved(saved, own)
        self.simulation.check(saved["simulation"])


def make_env(
    name: str,
    *,
    num_envs: int = 64,
    num_threads: int = 2,
    seed: int | None = None,
    device: torch.device | str | None = None,
    **task_kwargs: Any,
) -> BatchedEnv:
    """Batched TorchRL environment of a task, by name.

    Args:
        name: one of ``tasks.ALL_TASKS``.
        num_envs: number of simulations.
        num_threads: physics threads, 0 for all cores; does not change the results.
        seed: seed of all start states. Defaults to a draw from torch's global generator.
        device: where tensors go; the physics runs on the CPU. Defaults to the CPU.
        **task_kwargs: arguments of the task, such as ``episode_seconds``.

    Raises:
        KeyError: no such task; the message lists the names.
        TypeError: an argument that the task does not take.

    Example:
        >>> import tasks
        >>> env = tasks.make_env("cartpole", num_envs=16, num_threads=1, seed=0)
        >>> env.reset()["observation"].shape
        torch.Size([16, 3])
    """
    task = create(name, **task_kwargs)
    return BatchedEnv(task, num_envs, num_threads=num_threads, seed=seed, device=device)
