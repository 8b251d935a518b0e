"""The state of a batch of simulations, as a task sees it.

Everything a task computes - observation, reward, termination - is a function of one `State`: what
the physics holds (positions, velocities, mocap bodies), how long the episode has
lasted, and the task's own variables (a target, the last action, a curriculum level). The row index
is the simulation: every tensor has shape (n, ...).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchrl_sym import checks

Element = int | str | Tensor
"""A group element: its index, its name, or one index per row, ``(n,)``."""


@dataclass
class State:
    """Full state of n simulations, everything in SI units.

    Attributes:
        qpos: generalised positions, ``(n, nq)`` float64, m and rad (quaternions w, x, y, z).
        qvel: generalised velocities, ``(n, nv)`` float64, m/s and rad/s.
        mocap_pos: positions of the mocap bodies, ``(n, nmocap, 3)``, m; None: as in the model.
        mocap_quat: their orientations, ``(n, nmocap, 4)``; None: as in the model.
        time: time since the start of the episode, ``(n,)`` float64, s; zero when left out.
        variables: the task's own tensors by name, ``(n, ...)`` each.

    Raises:
        TypeError: something other than a tensor, or variables without names.
        ValueError: a tensor of another shape, or of other rows than ``qpos``.

    Example:
        >>> import torch
        >>> state = State(torch.zeros(3, 2), torch.ones(3, 2), variables={"target": torch.eye(3)})
        >>> state.rows(torch.tensor([2])).variables["target"]
        tensor([[0., 0., 1.]])
    """

    qpos: Tensor
    qvel: Tensor
    mocap_pos: Tensor | None = None
    mocap_quat: Tensor | None = None
    time: Tensor = None  # type: ignore[assignment]  # filled in __post_init__
    variables: dict[str, Tensor] = field(default_factory=dict)
    _memo: dict[str, Tensor] | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        n = _rows("qpos", self.qpos, 2)
        if self.time is None:
            self.time = torch.zeros(n, dtype=torch.float64, device=self.qpos.device)
        _rows("qvel", self.qvel, 2, n)
        _rows("time", self.time, 1, n)
        if self.mocap_pos is not None:
            _rows("mocap_pos", self.mocap_pos, 3, n, last=3)
        if self.mocap_quat is not None:
            _rows("mocap_quat", self.mocap_quat, 3, n, last=4)
        for name, value in checks.mapping("variables", self.variables, "names to tensors").items():
            if (
                not isinstance(name, str)
                or not isinstance(value, Tensor)
                or not value.ndim
                or len(value) != n
            ):
                raise ValueError(f"variable {name!r}: expected {n} rows by name, got {checks.shown(value)}")

    def mocap_place(self, body: int) -> Tensor:
        """Position of a mocap body, by its number, ``(n, 3)``, m; the live tensor.

        Raises:
            ValueError: the state says nothing of mocap bodies.
        """
        return _given("mocap_pos", self.mocap_pos)[:, body]

    def mocap_turn(self, body: int) -> Tensor:
        """Orientation of a mocap body, by its number, ``(n, 4)``; see :meth:`mocap_place`."""
        return _given("mocap_quat", self.mocap_quat)[:, body]

    def shared(self, name: str, compute: Callable[[], Tensor]) -> Tensor:
        """A quantity that reward, termination and observation of one step all need.

        Within a step of the batched environment it is computed once; elsewhere, every time. It must
        depend on positions and velocities only, since variables change in the middle of a step, and
        nobody may write into it.
        """
        if self._memo is None:
            return compute()
        if name not in self._memo:
            self._memo[name] = compute()
        return self._memo[name]

    def hold(self) -> None:
        """Keep what :meth:`shared` computes from now on; positions must not change any more."""
        self._memo = {}

    def release(self) -> None:
        """Forget what :meth:`shared` kept; positions may change."""
        self._memo = None

    def __len__(self) -> int:
        return len(self.qpos)

    def rows(self, ids: Tensor | slice) -> State:
        """A copy of some rows; ``ids`` is a slice, row numbers or a boolean mask."""
        try:
            return self._map(lambda x: x[ids].clone())
        except (IndexError, TypeError, ValueError) as error:
            raise ValueError(
                f"ids: expected a slice, row numbers below {len(self)} or a mask, got {checks.shown(ids)}"
            ) from error

    def clone(self) -> State:
        """A copy that shares no memory with the simulation."""
        return self._map(Tensor.clone)

    def to(self, device: torch.device) -> State:
        """The same on a device; what is there already is not copied."""
        return self._map(lambda x: x.to(device))

    def _map(self, function: Callable[[Tensor], Tensor]) -> State:
        return State(
            qpos=function(self.qpos),
            qvel=function(self.qvel),
            mocap_pos=None if self.mocap_pos is None else function(self.mocap_pos),
            mocap_quat=None if self.mocap_quat is None else function(self.mocap_quat),
            time=function(self.time),
            variables={name: function(x) for name, x in self.variables.items()},
        )


def _given(name: str, value: Tensor | None) -> Tensor:
    if value is None:
        raise ValueError(f"expected a state with {name}, which this task reads, got None; take env.state")
    return value


def _rows(name: str, value: Tensor, ndim: int, n: int | None = None, last: int | None = None) -> int:
    """Number of rows of a tensor of ``ndim`` dimensions; n of them, and a size ``last`` at the end."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name}: expected a tensor, got {checks.shown(value)}")
    shape = value.shape
    if len(shape) != ndim or n not in (None, shape[0]) or last not in (None, shape[-1]):
        sizes = f"{'' if n is None else n} rows first" + f", {last} last" * (last is not None)
        raise ValueError(f"{name}: expected {ndim} dimensions ({sizes.strip()}), got shape {tuple(shape)}")
    return shape[0]


def concatenate(states: Sequence[State]) -> State:
    """The rows of several states of one task, one after the other.

    Raises:
        ValueError: no states, or states of two tasks.
        TypeError: something other than states.

    Example:
        >>> import torch
        >>> one = State(torch.zeros(1, 2), torch.zeros(1, 2))
        >>> len(concatenate([one, one, one]))
        3
    """

    def join(parts: list[Tensor | None]) -> Tensor | None:
        given = [part for part in parts if part is not None]
        return torch.cat(given) if given else None

    states = [checks.instance("states", s, State) for s in checks.sequence("states", states, "states")]
    kinds = {(s.qpos.shape[1:], *sorted(s.variables)) for s in states}
    if len(kinds) != 1:
        raise ValueError(f"expected states of one task, got those of {len(kinds)}")
    first = states[0]
    return State(
        qpos=torch.cat([s.qpos for s in states]),
        qvel=torch.cat([s.qvel for s in states]),
        mocap_pos=join([s.mocap_pos for s in states]),
        mocap_quat=join([s.mocap_quat for s in states]),
        time=torch.cat([s.time for s in states]),
        variables={k: torch.cat([s.variables[k] for s in states]) for k in first.variables},
    )
