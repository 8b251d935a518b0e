"""The batched TorchRL face of a task: n simulations as one environment.

`BatchedEnv` ties a task's description to a `Simulation` and meets TorchRL's contract for batched
environments: it never resets itself (the true last observation of an episode is under "next", so
that time-outs can be bootstrapped), resets any subset of rows, and can be saved and continued bit
for bit.

Where the physics runs on a device, the host asks it nothing during a step or a reset, since to ask is to
wait: rows are masks there instead of numbers, start states are drawn for all rows and taken by those of the
mask, and what may have happened (an action that is not finite, a simulation that diverged) is treated as
if it had, by arithmetic that changes nothing where it has not. On the CPU asking is cheaper.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from tasks.base import Task
from tasks.checks import action_of, check_saved, check_start, rows_of
from tasks.draws import put
from tasks.engines import EngineName, make_engine
from tasks.processes import Generator, by_value, from_value
from tasks.simulation import Simulation
from tasks.specs import make_specs
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
        num_threads: physics threads on the CPU, 0 for all cores; does not change the results.
        seed: seed of all start states. Defaults to a draw from torch's global generator.
        device: where tensors go. Defaults to the CPU.
        engine: what steps the simulations: ``"mujoco"``, on CPU threads, or ``"warp"``, on the device. None
            for ``"warp"`` on CUDA, else ``"mujoco"``.

    Attributes:
        task: the description.
        symmetry: the task's :class:`~torchrl_sym.Symmetry`.
        simulation: the physics.
        engine: what it was asked to be.
        num_diverged: simulations that diverged since construction; on a device, a number there.

    Raises:
        TypeError: not a task, or a number of another type.
        ValueError: a number out of range, or a task that contradicts itself.
        ImportError: the physics on a GPU is not installed.

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
        engine: EngineName | None = None,
    ) -> None:
        if not isinstance(task, Task):
            raise TypeError(
                f"expected a task, got {type(task).__name__}; tasks.make_env takes a task's name"
            )
        if seed is not None:  # before the physics is made
            seed = checks.whole("seed", seed, 0, MAX_SEED)
        simulation = make_engine(task, num_envs, num_threads=num_threads, device=device, engine=engine)
        asks = isinstance(simulation, Simulation)
        place = simulation.qpos.device
        super().__init__(device=device if asks else place, batch_size=torch.Size([num_envs]))
        self.task = task
        self.simulation = simulation
        self.engine = engine
        self.num_diverged: Any = 0
        self._asks = asks  # whether to ask what happened costs nothing
        self._place = place  # of the physics; a task computes there too
        self._generator = Generator(place)
        self._action_shape = torch.Size((num_envs, task.action_size))
        specs = make_specs(task, num_envs, self.device)
        self.observation_spec, self.action_spec, self.reward_spec, self.full_done_spec = specs
        self._substeps = task.substeps
        # Time adds up rounding errors; half a control step is far above them.
        self._time_limit = (task.max_steps - 0.5) * task.control_timestep
        start = task.sample_initial_state(1, torch.Generator().manual_seed(0))
        self._check_task(start)
        like = {"dtype": None if asks else simulation.qpos.dtype, "device": place}
        self._state = self._state_with(
            {name: x.new_zeros(num_envs, *x.shape[1:], **like) for name, x in start.variables.items()}
        )
        self._over = torch.zeros(num_envs, dtype=torch.bool, device=place)  # rows whose episode has ended
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
        self._state = self._state_with(from_value(state["_state"], self._place))

    @property
    def symmetry(self):
        """How the task's group acts on observation and action."""
        return self.task.symmetry

    @property
    def state(self) -> State:
        """A copy of the full state of all rows."""
        return self._state.clone()

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
        action = action_of(tensordict, self._action_shape, self._place)
        lost = None
        if not (self._asks and math.isfinite(float(action.sum()))):
            lost = ~action.isfinite().all(dim=-1, keepdim=True)
            action = action.masked_fill(lost, 0.0)
        ctrl = task.control(action, state)
        if lost is not None:
            ctrl = ctrl.masked_fill(lost, math.nan)  # which the simulation reports
        active = tensordict.get("_step", None)  # TorchRL skips rows that are done in some rollouts
        if active is not None:
            active = rows_of("_step", active, len(state), self._place)
        diverged = None
        if simulation.step(ctrl, self._substeps, active):
            diverged = simulation.diverged()
            count = diverged.sum()
            self.num_diverged = self.num_diverged + (int(count) if self._asks else count)
            action = action.masked_fill(diverged[:, None], 0.0)
        state.hold()
        reward = task.reward(state, action)
        for name, value in task.update(state, action).items():
            own = state.variables[name]
            if active is None:
                own.copy_(value)
            else:
                put(own, active, value)
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
        over = self._over
        rows = torch.ones_like(over) if mask is None else rows_of("_reset", mask, len(over), self._place)
        continued, self._restored = self._restored and bool(rows.all()), False
        if continued:  # only episodes that had ended when saved begin anew
            rows = over.clone()
        if not continued or bool(rows.any()):  # or a device would draw starts that nobody takes
            self._begin(rows)
        if self._stagger and bool(rows.all()):
            self._stagger = False
            draw = {"generator": self._generator, "device": self._place}
            steps = torch.randint(self.task.max_steps, rows.shape, **draw)
            self._state.time[:] = steps * self.task.control_timestep
        return self._first_output()

    def _begin(self, rows: Tensor) -> None:
        """Start episodes of the rows of a mask; which they are is asked only where that costs nothing."""
        task, generator = self.task, self._generator
        ids = rows.nonzero().squeeze(-1) if self._asks else rows
        if not len(ids):
            return
        if not self._started:
            start = task.sample_initial_state(len(ids), generator)
        elif self._asks:
            start = task.restart(self._state.rows(ids), generator)
        else:
            start = task.restart(self._state, generator, rows)
        self._write(ids, start, finite=self._asks)
        task.randomize(self.simulation, ids, generator)

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
        if not self._asks and isinstance(state, State):
            state = state.to(self._place)
        self._write(torch.arange(*self.batch_size) if self._asks else torch.ones_like(self._over), state)
        self._restored = False
        return self._first_output()

    def _write(self, ids: Tensor, start: State, *, finite: bool = True) -> None:
        own = self._state.variables
        check_start(start, own, len(ids), finite=finite)
        self.simulation.write(ids, start.qpos, start.qvel, start.mocap_pos, start.mocap_quat, start.time)
        for name, value in start.variables.items():
            put(own[name], ids, value)
        self._started = True
        # not in place: outputs may share it
        self._over = self._over.index_fill(0, ids, False) if self._asks else self._over & ~ids

    def _first_output(self) -> TensorDict:
        flags = torch.zeros(3, *self.batch_size, 1, dtype=torch.bool, device=self._place)
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
            "num_diverged": int(self.num_diverged),
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
            self._generator.set_state(saved["generator"].cpu())
            self.task.load_state_dict(saved["task"])
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
            raise ValueError(
                f"expected the saved generator and what task {self.task.name!r} saves, got something else "
                f"({type(error).__name__}: {error}); restore what save_state() returned"
            ) from error
        self.simulation.load(saved["simulation"])
        own = self._place
        self._state.variables = {name: x.to(own, copy=True) for name, x in saved["variables"].items()}
        self._over = saved["over"].to(own, copy=True)
        self._started = saved["started"]
        self.num_diverged = saved["num_diverged"]
        self._restored = self._started

    def _check_saved(self, saved: Any) -> None:
        own = self.save_state()
        if isinstance(saved, dict):  # the simulation and the task look at theirs themselves
            own |= {key: saved[key] for key in ("simulation", "task") if isinstance(saved.get(key), dict)}
        check_saved(saved, own)
        self.simulation.check(saved["simulation"])
