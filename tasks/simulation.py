"""Batched physics behind a small interface.

`Simulation` runs n copies of one MuJoCo model on a pool of C++ threads (`mujoco.batch`): set the
controls, step, read the state through live tensors, write rows. It knows nothing of tasks, rewards
or TorchRL; what those may rely on is the interface `tasks.engine.Engine`.

Two rules make it safe to learn on. A simulation that diverges is reported once, by `diverged`, and
put back at the model's reference configuration at rest, so that no later read sees NaN. And results
do not depend on the number of threads, so that a seed reproduces a run on any machine.
"""

from __future__ import annotations

import math
import time
from typing import Any

import mujoco
import torch
from mujoco.batch import Batch, SimulationError
from torch import Tensor

from tasks.checks import check_saved
from tasks.engine import MAX_ENVS, Engine, given, positive_velocity
from tasks.processes import LostThreads, by_value, from_value, prepare_for_forks
from torchrl_sym import checks

MAX_THREADS = 2**10


class Simulation(Engine):
    """n simulations of one MuJoCo model, stepped on a thread pool.

    The attributes ``qpos`` (n, nq), ``qvel`` (n, nv), ``time`` (n,), ``ctrl`` (n, nu),
    ``mocap_pos`` (n, nmocap, 3) and ``mocap_quat`` (n, nmocap, 4) are live float64 views of the
    simulations' memory in MuJoCo's units (m, rad, s, N): they change with every step, so copy what
    you keep. Start episodes with :meth:`write`, not through the views: it also clears what the
    solver remembers. ``seconds`` is the time spent stepping.

    Pickled or copied it continues exactly, with threads of its own. A forked child has no physics
    threads: there, unless one thread steps them all, what would need them is an error.

    Args:
        model: the compiled model; shared by all simulations.
        num_envs: number of simulations n.
        num_threads: physics threads, 0 for all cores. Does not change the results.
        max_velocity: a row with an entry of ``|qvel|`` above this (m/s or rad/s) counts as
            diverged, well before MuJoCo's own limit of 1e10.

    Raises:
        TypeError: a size that is not a whole number.
        ValueError: a size out of range.

    Example:
        >>> import mujoco, torch
        >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><body>
        ...   <joint type="slide" axis="0 0 1"/><geom size=".1"/></body></worldbody></mujoco>''')
        >>> simulation = Simulation(model, num_envs=3, num_threads=1)
        >>> simulation.step(torch.zeros(3, 0), substeps=10)  # has any simulation diverged?
        False
        >>> simulation.qpos.shape, bool((simulation.qvel < 0).all())
        (torch.Size([3, 1]), True)
    """

    def __init__(
        self,
        model: mujoco.MjModel,  # pyright: ignore[reportAttributeAccessIssue]
        num_envs: int,
        num_threads: int = 2,
        *,
        max_velocity: float = 1000.0,
    ) -> None:
        num_envs = checks.whole("num_envs", num_envs, 1, MAX_ENVS)
        num_threads = checks.whole("num_threads (0 for all cores)", num_threads, 0, MAX_THREADS)
        self.model = model
        self.num_envs = num_envs
        self.num_threads = num_threads
        self.max_velocity = positive_velocity(max_velocity)
        self._batch: Batch | LostThreads = Batch(model, num_envs, num_threads)
        self._one_thread = self._batch.nthread == 1
        self._stepping = False  # in some thread of this process
        prepare_for_forks(self._batch.state.base, self)  # the pool, which every view keeps alive
        self._state = torch.from_numpy(self._batch.state)
        self.qpos = self._view("qpos")
        self.qvel = self._view("qvel")
        self.time = self._view("time")
        self.ctrl = self._view("ctrl")
        self.mocap_pos = self._view("mocap_pos")
        self.mocap_quat = self._view("mocap_quat")
        self._warnings = self._batch.warning  # (n, kinds, 2): last info and count, live
        self._warnings_flat = self._warnings.reshape(-1)
        self._reference = self._state[0].clone()
        self._none_diverged = torch.zeros(num_envs, dtype=torch.bool)
        self._diverged = self._none_diverged
        self._expanded: dict[str, Tensor] = {}
        self._unexpanded: dict[str, Tensor] = {}  # the model's own values of the same fields
        self.seconds = 0.0  # spent stepping

    def _view(self, name: str) -> Tensor:
        return torch.from_numpy(self._batch.bind(name))

    def lose_threads(self) -> None:
        """In a forked child: from now on, using threads that do not exist here is an error."""
        if self._stepping or not self._one_thread:
            self._batch = LostThreads()

    def __getstate__(self) -> dict[str, Any]:
        made = {name: getattr(self, name) for name in ("model", "num_envs", "num_threads", "max_velocity")}
        now = {"saved": by_value(self.save()), "diverged": self._diverged, "seconds": self.seconds}
        return {"made": made, **now}

    def __setstate__(self, state: dict[str, Any]) -> None:
        Simulation.__init__(self, **state["made"])
        self.load(from_value(state["saved"]))
        self._diverged, self.seconds = state["diverged"], state["seconds"]

    def step(self, ctrl: Tensor, substeps: int = 1, ids: Tensor | None = None) -> bool:
        """Advance by ``substeps`` timesteps of the model with constant controls.

        A row whose control is not finite is stepped with zero control and reported as diverged.

        Args:
            ctrl: ``(n, nu)`` in the units of the model's actuators.
            substeps: physics steps per call.
            ids: step only these rows (numbers in increasing order, or a mask); the others stay as
                they are.

        Returns:
            Whether any row diverged; :meth:`diverged` says which.
        """
        self._check_control(ctrl)
        self.ctrl.copy_(ctrl)
        diverged = self._none_diverged
        if not math.isfinite(float(ctrl.sum())):
            diverged = ~self.ctrl.isfinite().all(dim=-1)
            self.ctrl[diverged] = 0.0
            if ids is not None:
                diverged = diverged & torch.zeros_like(diverged).index_fill(0, _numbers(ids), True)
        start = time.perf_counter()
        self._stepping = True
        try:
            self._batch.step(None if ids is None else ids.numpy(), nstep=substeps)
        except SimulationError as error:  # only the rows in error.ids failed
            diverged = diverged.clone()
            diverged[torch.as_tensor(error.ids, dtype=torch.int64)] = True
        finally:
            self._stepping = False
        self.seconds += time.perf_counter() - start
        self._diverged = diverged | self._lost() if self._any_lost() else diverged
        if self._diverged is self._none_diverged:
            return False
        self._park(self._diverged)
        return bool(self._diverged.any())

    def _any_lost(self) -> bool:
        """Whether any row may have diverged: two reductions, the only price of a healthy step.

        No test for non-finite numbers is needed: MuJoCo checks positions, velocities and
        accelerations in every step, warns and resets the row.
        """
        low, high = self.qvel.aminmax()
        healthy = -self.max_velocity <= float(low) and float(high) <= self.max_velocity  # False for NaN
        return not healthy or int(self._warnings_flat.max()) > 0

    def _lost(self) -> Tensor:
        too_fast = ~(self.qvel.abs() <= self.max_velocity).all(dim=-1)
        warned = torch.from_numpy(self._warnings[:, :, 1].any(axis=-1))
        return too_fast | warned

    def _park(self, rows: Tensor) -> None:
        self._warnings[rows.numpy()] = 0
        self._state[rows] = self._reference

    def diverged(self) -> Tensor:
        """Rows that diverged in the last :meth:`step`, ``(n,)`` bool; do not write into it.

        A row diverges when its control or its state stops being finite, when it moves faster than
        ``max_velocity``, or when MuJoCo warns about it or fails on it. It then stands at the
        model's reference configuration, at rest, and can be stepped or written again.

        Example:
            >>> import mujoco, torch
            >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><body>
            ...     <joint type="slide" axis="0 0 1"/><geom size=".1"/>
            ...   </body></worldbody></mujoco>''')
            >>> simulation = Simulation(model, num_envs=2, num_threads=1, max_velocity=100.0)
            >>> simulation.qvel[1] = 1e6
            >>> simulation.step(torch.zeros(2, 0))
            True
            >>> simulation.diverged()
            tensor([False,  True])
        """
        return self._diverged

    def write(
        self,
        ids: Tensor | None,
        qpos: Tensor,
        qvel: Tensor,
        mocap_pos: Tensor | None = None,
        mocap_quat: Tensor | None = None,
        time: Tensor | None = None,
    ) -> None:
        """Start rows afresh: all that is not given returns to the model's defaults.

        That includes the controls, the actuator states and the solver's warm start, which
        would otherwise carry the previous episode into the next one.

        Args:
            ids: the rows, as numbers or a mask of n; None for all. k rows are written; a mask also takes
                values of all n rows, of which it chooses.
            qpos: ``(k, nq)``.
            qvel: ``(k, nv)``.
            mocap_pos: ``(k, nmocap, 3)``, or None for the model's.
            mocap_quat: ``(k, nmocap, 4)``, or None for the model's.
            time: ``(k,)``, s, or None for zero.

        Raises:
            TypeError: a value that is not a tensor.
            ValueError: a value that is not finite, or a wrong shape.
        """
        rows = slice(None) if ids is None else ids
        start = given(qpos=qpos, qvel=qvel, mocap_pos=mocap_pos, mocap_quat=mocap_quat, time=time)
        if ids is not None and ids.dtype == torch.bool:
            start = {name: x[ids] if _rows(x) == self.num_envs else x for name, x in start.items()}
        self._check_start(start, len(self._none_diverged[rows]), finite=True)
        self._state[rows] = self._reference
        for name, value in start.items():
            getattr(self, name)[rows] = value.to(torch.float64)

    def expand(self, name: str) -> Tensor:
        """Give a model field its own value per simulation (domain randomisation).

        Args:
            name: an ``MjModel`` field such as ``"body_mass"``, ``"geom_friction"``.

        Returns:
            The live ``(n, ...)`` values, to be written in place. Call :meth:`refresh` after writing
            masses, inertias or anything else that MuJoCo derives constants from.
        """
        if name not in self._expanded:
            self._expanded[name] = torch.from_numpy(self._batch.expand(name))
            self._unexpanded[name] = self._expanded[name][0].clone()
        return self._expanded[name]

    def refresh(self, ids: Tensor | None = None) -> None:
        """Recompute the constants that MuJoCo derives from expanded fields (``mj_setConst``)."""
        self._stepping = True
        try:
            self._batch.set_const(None if ids is None else ids.numpy())
        finally:
            self._stepping = False

    def data(self, row: int) -> mujoco.MjData:  # pyright: ignore[reportAttributeAccessIssue]
        """One simulation as an ``MjData`` of its own with all derived fields, to be rendered."""
        data = self._batch.get_data(row)
        mujoco.mj_forward(self._batch.get_model(row), data)  # pyright: ignore[reportAttributeAccessIssue]
        return data

    def save(self) -> dict[str, Tensor]:
        """Everything that decides the future, copied: state rows, per-simulation model fields."""
        expanded = {f"model.{name}": x.clone() for name, x in self._expanded.items()}
        return {"rows": self._state.clone(), **expanded}

    def load(self, saved: dict[str, Tensor]) -> None:
        """Continue from :meth:`save`, bit for bit.

        Raises:
            ValueError: the state belongs to another model or another number of simulations.
        """
        self.check(saved)
        self._state.copy_(saved["rows"])
        fields = {key.removeprefix("model."): x for key, x in saved.items() if key != "rows"}
        for name, value in (self._unexpanded | fields).items():
            self.expand(name).copy_(value)
        if self._expanded:
            self.refresh()
        self._warnings[:] = 0
        self._diverged = self._none_diverged

    def check(self, saved: dict[str, Tensor]) -> None:
        """Raise ValueError unless :meth:`load` can continue from this."""
        own = {"rows": self._state}
        for key in saved if isinstance(saved, dict) else ():
            if key.startswith("model."):
                own[key] = self.expand(key.removeprefix("model."))
        check_saved(saved, own)


def _rows(value: Any) -> int | None:
    return len(value) if isinstance(value, Tensor) and value.ndim else None


def _numbers(ids: Tensor) -> Tensor:
    """Rows as numbers, given as numbers or as a mask."""
    return ids.nonzero().squeeze(-1) if ids.dtype == torch.bool else ids
