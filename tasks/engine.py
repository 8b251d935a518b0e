"""What a physics engine offers to the environments and tasks above it.

An `Engine` is n copies of one MuJoCo model that are stepped together: set the controls, step, read the
state through live tensors, write rows. There are two. `tasks.simulation.Simulation` runs MuJoCo's own C
library on CPU threads in double precision: the default, and the reference. `tasks.warp_simulation.
WarpSimulation` runs mujoco_warp in single precision on a GPU, where the state never leaves the card.

What runs on both relies on this interface alone, and therefore

* takes precision and device from the engine's tensors (``qpos.dtype``, ``qpos.device``), not from a habit;
* treats the answer of :meth:`Engine.step` as "may have", and finds out by arithmetic with the mask of
  :meth:`Engine.diverged` instead of by asking it: a question to a device makes everything wait;
* for the same reason starts rows by a mask with values for all n rows, rather than by k rows.
"""

from __future__ import annotations

import abc
from collections.abc import Mapping
from typing import Any

from torch import Tensor

MAX_ENVS = 2**20  # more are refused, before the memory or the machine gives way


class Engine(abc.ABC):
    """n simulations of one MuJoCo model.

    The live tensors are views of the simulations' memory in MuJoCo's units (m, rad, s, N). They change with
    every step, so copy what you keep, and start episodes by :meth:`write`, not through them.

    Attributes:
        model: the compiled ``MjModel``, shared by all simulations.
        num_envs: number of simulations n.
        max_velocity: a row with an entry of ``|qvel|`` above this (m/s or rad/s) counts as diverged.
        qpos: ``(n, nq)``, live.
        qvel: ``(n, nv)``, live.
        time: ``(n,)`` float64, live; seconds since the episode began.
        ctrl: ``(n, nu)``, live; the controls of the last step.
        mocap_pos: ``(n, nmocap, 3)``, live.
        mocap_quat: ``(n, nmocap, 4)``, live.
        seconds: time the host has spent in :meth:`step`; may be set back to zero.

    Example:
        >>> from tasks.simulation import Simulation
        >>> issubclass(Simulation, Engine)
        True
    """

    model: Any
    num_envs: int
    max_velocity: float
    qpos: Tensor
    qvel: Tensor
    time: Tensor
    ctrl: Tensor
    mocap_pos: Tensor
    mocap_quat: Tensor
    seconds: float

    @abc.abstractmethod
    def step(self, ctrl: Tensor, substeps: int = 1, ids: Tensor | None = None) -> bool:
        """Advance by ``substeps`` timesteps of the model with constant controls.

        Args:
            ctrl: ``(n, nu)``; a row that is not finite is stepped with zero control and diverges.
            substeps: physics steps.
            ids: step only these rows (numbers in increasing order, or a mask).

        Returns:
            False only if no row diverged. An engine for which looking would be a stop returns True.
        """

    @abc.abstractmethod
    def diverged(self) -> Tensor:
        """Rows that diverged in the last :meth:`step`, ``(n,)`` bool; do not write into it.

        They stand at the model's reference configuration, at rest: no read ever sees NaN.
        """

    @abc.abstractmethod
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

        Args:
            ids: k rows, as numbers or a mask of n; None for all. A mask takes values of its k rows, or of
                all n, of which it chooses.
            qpos: ``(k, nq)`` or ``(n, nq)``, and so on.
            qvel: ``(k, nv)``.
            mocap_pos: ``(k, nmocap, 3)``.
            mocap_quat: ``(k, nmocap, 4)``.
            time: ``(k,)``, s.

        Raises:
            TypeError: a value that is not a tensor.
            ValueError: a wrong shape, or a value that is not finite; an engine for which looking would be a
                stop starts such a row at the reference configuration and reports it in the next step.
        """

    @abc.abstractmethod
    def expand(self, name: str) -> Tensor:
        """The live ``(n, ...)`` values of a model's field, one per simulation, to be written in place.

        Call :meth:`refresh` after writing masses, inertias or anything else that MuJoCo derives constants
        from.

        Raises:
            ValueError: no such field, or one that cannot differ between simulations.
        """

    @abc.abstractmethod
    def refresh(self, ids: Tensor | None = None) -> None:
        """Recompute the constants that MuJoCo derives from expanded fields (``mj_setConst``)."""

    @abc.abstractmethod
    def data(self, row: int) -> Any:
        """One simulation as an ``MjData`` of its own with all derived fields, to be rendered."""

    @abc.abstractmethod
    def save(self) -> dict[str, Tensor]:
        """Everything that decides the future, copied: ``rows``, and ``model.*`` for what was expanded."""

    @abc.abstractmethod
    def load(self, saved: dict[str, Tensor]) -> None:
        """Continue from :meth:`save`.

        Raises:
            ValueError: the state belongs to another model, number of simulations or engine.
        """

    @abc.abstractmethod
    def check(self, saved: dict[str, Tensor]) -> None:
        """Raise ValueError unless :meth:`load` can continue from this."""

    def _check_control(self, ctrl: Tensor) -> None:
        if ctrl.shape != self.ctrl.shape:  # copying would broadcast
            raise ValueError(
                f"expected ctrl of shape {tuple(self.ctrl.shape)} (num_envs, actuators), got "
                f"{tuple(ctrl.shape)}; check the task's control()"
            )

    def _check_start(self, start: Mapping[str, Tensor], rows: int, *, finite: bool) -> None:
        """Refuse values of another type or shape; and if it may be asked, what is not finite."""
        for name, value in start.items():
            if not isinstance(value, Tensor):
                kind = type(value).__name__
                raise TypeError(f"{name}: expected a tensor, got {kind}; use torch.as_tensor")
            expected = (rows, *getattr(self, name).shape[1:])
            if tuple(value.shape) != expected or (finite and not bool(value.isfinite().all())):
                raise ValueError(
                    f"expected finite {name} of shape {expected}, got shape {tuple(value.shape)} "
                    f"with {int((~value.isfinite()).sum())} entries that are not finite; check "
                    "how the start states are sampled"
                )


def given(**fields: Tensor | None) -> dict[str, Tensor]:
    """Those that are not None."""
    return {name: value for name, value in fields.items() if value is not None}


def positive_velocity(max_velocity: float) -> float:
    """A limit that a velocity can exceed.

    Raises:
        ValueError: zero, negative or NaN.
    """
    if not max_velocity > 0:
        raise ValueError(f"expected max_velocity > 0, got {max_velocity}")
    return max_velocity
