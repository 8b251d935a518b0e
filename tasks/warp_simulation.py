"""The physics on a GPU: MuJoCo Warp behind the interface of an engine.

`WarpSimulation` steps n simulations of one model with mujoco_warp, on a CUDA device or, for tests, on the
CPU. Its tensors share warp's memory, so that a policy, a task and the physics work on one copy of the state
in one place. Stepping copies nothing from the device and never waits for it: the substeps of a control
step are one graph of kernels (captured in the first step, and again when a field of the model gets new
arrays), and whatever depends on the state is arithmetic with masks.

Differences from MuJoCo's own library that callers see:

* Positions and velocities are float32; time is float64, since sums of small steps are compared with the
  length of an episode. Mirrored states stay mirrored to 1e-5 or so, not to 1e-12.
* Contacts live in one pool for all simulations, and constraints in a table for each. What does not fit is
  lost, and a row that may have lost something has diverged: it ends, rather than being wrong in silence.
  When the pool is full nobody knows whose contacts are missing, and every row that was stepped ends.
* The same program gives the same bits on the CPU. On CUDA the order of contacts is a race, and with it the
  last bits of their sums: a saved state is continued, but not bit for bit.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import torch
from torch import Tensor

from tasks.checks import check_saved
from tasks.engine import MAX_ENVS, Engine, given, positive_velocity
from tasks.processes import by_value, from_value
from tasks.warp_fields import Fields, mjw, wp
from torchrl_sym import checks

mj: Any = mujoco  # its compiled modules have no type stubs
wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)  # or every kernel is announced

# Room of a simulation in the pool of contacts, and in its table of constraints beyond those that the model
# always has. Our robots have one to five contacts at rest, of up to four constraints each.
CONTACTS, CONSTRAINTS = 48, 160
MAX_ROOM = 2**16  # more is refused
MAX_VALUE = mj.mjMAXVAL  # of positions and accelerations; MuJoCo resets what exceeds it

# What the next step depends on: fields of mjw.Data. Models that remember more are refused.
REMEMBERED = ("qpos", "qvel", "act", "history", "qacc_warmstart", "ctrl", "mocap_pos", "mocap_quat")
# A solver that reaches its limit of iterations is ordinary; all other flags lose contacts or constraints.
LOSSES = int(mjw.OverflowType.ALL & ~(mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS))


class WarpSimulation(Engine):
    """n simulations of one MuJoCo model, stepped by mujoco_warp on one device.

    An :class:`~tasks.engine.Engine`, which says what the methods do; here is what is particular to this
    one. The first step compiles kernels: a minute or two on CUDA, some ten seconds on a CPU. They are kept
    for the next process in ``wp.config.kernel_cache_dir`` (environment variable ``WARP_CACHE_PATH``, by
    default the user's cache). Pickled or copied it continues from the same state.

    Args:
        model: the compiled model.
        num_envs: number of simulations n.
        device: ``"cuda"``, one of several (``"cuda:1"``), or ``"cpu"``.
        nconmax: contacts per simulation for which the common pool has room; 48 by default.
        njmax: constraints for which every simulation has room: a limit that is reached is one, a contact
            up to four (ten with rolling friction and pyramidal cones). By default 160, and as many as the
            model can have without contacts.
        max_velocity: a row with an entry of ``|qvel|`` above this (m/s or rad/s) counts as diverged.

    Attributes:
        num_diverged: rows that diverged since construction, a number on the device.
        num_overflowed: those among them for which there was no room, a number on the device.

    Raises:
        TypeError: a number of another type, or not a device.
        ValueError: a number out of range, a device that is not there, or a model that mujoco_warp cannot
            step, or that remembers what is not saved here (bodies that sleep, flexible ones).

    Example:
        >>> import mujoco, torch
        >>> model = mujoco.MjModel.from_xml_string('''<mujoco><option><flag contact="disable"/></option>
        ...   <worldbody><body><joint type="slide" axis="0 0 1"/><geom size=".1"/></body></worldbody>
        ... </mujoco>''')
        >>> simulation = WarpSimulation(model, num_envs=3, device="cpu")
        >>> simulation.step(torch.zeros(3, 0), substeps=10)  # may any simulation have diverged?
        True
        >>> int(simulation.diverged().sum()), bool((simulation.qvel < 0).all())
        (0, True)
    """

    def __init__(
        self,
        model: mujoco.MjModel,  # pyright: ignore[reportAttributeAccessIssue]
        num_envs: int,
        device: torch.device | str = "cuda",
        *,
        nconmax: int | None = None,
        njmax: int | None = None,
        max_velocity: float = 1000.0,
    ) -> None:
        contacts, constraints = _room(model)
        self.num_envs = checks.whole("num_envs", num_envs, 1, MAX_ENVS)
        self.nconmax = checks.whole("nconmax", contacts if nconmax is None else nconmax, 1, MAX_ROOM)
        self.njmax = checks.whole("njmax", constraints if njmax is None else njmax, 1, MAX_ROOM)
        self.max_velocity = positive_velocity(max_velocity)
        self.device = _device(device)
        self.model = model
        self._place = wp.get_device(str(self.device))
        with wp.ScopedDevice(self._place):
            self._make(model)
        wp.synchronize_device(self._place)

        self._rows = {name: wp.to_torch(getattr(self._data, name)) for name in REMEMBERED}
        no = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self._rows["time"] = torch.zeros_like(no, dtype=torch.float64)
        self._rows["refused"] = no.clone()  # by write, to be reported by the next step
        self._reference = {name: x[:1].clone() for name, x in self._rows.items()}
        self.qpos, self.qvel, self.ctrl = (self._rows[name] for name in ("qpos", "qvel", "ctrl"))
        self.mocap_pos, self.mocap_quat = self._rows["mocap_pos"], self._rows["mocap_quat"]
        self.time = self._rows["time"]
        self._clock = wp.to_torch(self._data.time)  # of sensors and delays; its float32 would drift
        self._overflow = wp.to_torch(self._data.overflow)
        self._unconstrained = wp.to_torch(
            self._data.qacc_smooth
        )  # acceleration without contacts and limits
        self._diverged = no
        self.num_diverged, self.num_overflowed = torch.zeros(2, dtype=torch.int64, device=self.device)
        self.seconds = 0.0

    def _make(self, model: Any) -> None:
        remedy = "take tasks.simulation.Simulation"
        if model.nflex or model.opt.enableflags & mj.mjtEnableBit.mjENBL_SLEEP:
            raise ValueError(f"expected a model of rigid bodies that never sleep, got another; {remedy}")
        try:
            self._physics = mjw.put_model(model)
            room = {"nworld": self.num_envs, "nconmax": self.nconmax, "njmax": self.njmax}
            self._data = mjw.put_data(model, mj.MjData(model), **room)
        except NotImplementedError as error:
            raise ValueError(
                f"expected a model that mujoco_warp can step, got one for which it says: {error} {remedy}"
            ) from error
        self._physics.opt.warn_overflow = 0  # or kernels print what is read from the flags here
        self._physics.opt.graph_conditional = self._place.is_cpu or wp.is_conditional_graph_supported()
        self._fields = Fields(model, self._physics, self.num_envs)
        self._graphs: dict[str, Any] = {}
        self._graph_arrays = 0  # fields with arrays of their own when the graphs were captured

    def __getstate__(self) -> dict[str, Any]:
        names = ("model", "num_envs", "device", "nconmax", "njmax", "max_velocity")
        made = {name: getattr(self, name) for name in names}
        saved = {name: x.cpu() for name, x in self.save().items()}
        counts = (self._diverged.cpu(), int(self.num_diverged), int(self.num_overflowed), self.seconds)
        return {"made": made, "saved": by_value(saved), "counts": counts}

    def __setstate__(self, state: dict[str, Any]) -> None:
        WarpSimulation.__init__(self, **state["made"])
        self.load(from_value(state["saved"]))
        diverged, num_diverged, num_overflowed, self.seconds = state["counts"]
        self._diverged = diverged.to(self.device)
        self.num_diverged += num_diverged
        self.num_overflowed += num_overflowed

    def step(self, ctrl: Tensor, substeps: int = 1, ids: Tensor | None = None) -> bool:
        """Advance by ``substeps`` timesteps of the model with constant controls.

        Returns:
            True: rows may have diverged, and :meth:`diverged` says which. To know it here, the host would
            have to wait for the device. A tensor would only hide that: the ``if`` that every caller
            writes for the other engine would wait for its value.
        """
        self._check_control(ctrl)
        start = time.perf_counter()
        self.ctrl.copy_(ctrl)
        lost = self._rows["refused"] | ~self.ctrl.isfinite().all(dim=-1)
        self.ctrl.masked_fill_(lost[:, None], 0.0)
        stepped = None if ids is None else self._mask(ids)
        before = {} if stepped is None else {name: x.clone() for name, x in self._rows.items()}
        self._clock.copy_(self.time)
        self._launch(f"step {substeps}", functools.partial(self._advance, substeps))
        self.time += substeps * self.model.opt.timestep

        overflowed = (self._overflow & LOSSES) != 0
        lost = lost | overflowed | self._lost()
        if stepped is not None:
            lost, overflowed = lost & stepped, overflowed & stepped
            _put(self._rows, ~stepped, before)
        _put(self._rows, lost, self._reference)
        self._diverged = lost
        self.num_diverged += lost.sum()
        self.num_overflowed += overflowed.sum()
        self.seconds += time.perf_counter() - start
        return True

    def _advance(self, substeps: int) -> None:
        self._data.overflow.zero_()
        for _ in range(substeps):
            mjw.step(self._physics, self._data)

    def _lost(self) -> Tensor:
        """Rows that are too fast, too far away, pushed too hard, or NaN, for which no comparison holds.

        Above 1e18 or so the solver's cost is no float32 any more, and it returns its first guess: a force
        that is beyond all limits would pass as none.
        """
        far = [self._rows[name] for name in ("qpos", "act", "qacc_warmstart")]
        within = [(x.abs() <= MAX_VALUE).all(dim=-1) for x in (*far, self._unconstrained)]
        within.append((self.qvel.abs() <= self.max_velocity).all(dim=-1))
        return ~torch.stack(within).all(dim=0)

    def _launch(self, name: str, work: Callable[[], None]) -> None:
        """Run kernels in torch's current stream, as a graph that is captured once under this name."""
        if self._graph_arrays != len(self._fields.values):  # graphs hold the addresses of arrays
            self._graphs.clear()
            self._graph_arrays = len(self._fields.values)
        if name not in self._graphs:
            self._graphs[name] = self._capture(work)
        stream = wp.stream_from_torch(self.device) if self._place.is_cuda else None
        wp.capture_launch(self._graphs[name], stream)

    def _capture(self, work: Callable[[], None]) -> Any:
        before = {name: x.clone() for name, x in self._rows.items()}
        wp.synchronize_device(self._place)
        with wp.ScopedDevice(self._place):
            work()  # compiles and loads the kernels, which a capture cannot
            wp.synchronize_device(self._place)
            with wp.ScopedCapture(self._place) as capture:
                work()
        _put(self._rows, torch.ones_like(self._diverged), before)
        return capture.graph

    def _mask(self, ids: Tensor) -> Tensor:
        ids = ids.to(self.device)
        return ids if ids.dtype == torch.bool else torch.zeros_like(self._diverged).index_fill(0, ids, True)

    def diverged(self) -> Tensor:
        """Rows that diverged in the last :meth:`step`, ``(n,)`` bool on the device; do not write into it.

        A row diverges when its control, its state or what it was started with is not finite, when it moves
        faster than ``max_velocity``, is further away or accelerated more than MuJoCo allows, or when it
        had, or may have had, more contacts or constraints than there is room for.
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

        A row with a value that is not finite starts at the reference configuration, and diverges in the
        next step. To learn how many rows a mask has is a stop: give values for all n rows with it.
        """
        start = given(qpos=qpos, qvel=qvel, mocap_pos=mocap_pos, mocap_quat=mocap_quat, time=time)
        numbers = None if ids is None else ids.to(self.device)
        if numbers is not None and numbers.dtype == torch.bool:
            each = isinstance(qpos, Tensor) and qpos.shape[:1] == numbers.shape
            numbers = None if each else numbers.nonzero().squeeze(-1)
        self._check_start(start, self.num_envs if numbers is None else len(numbers), finite=False)

        mask = torch.ones_like(self._diverged) if ids is None else self._mask(ids)
        refused = torch.zeros_like(mask)
        values = {name: x.expand_as(self._rows[name]) for name, x in self._reference.items()}
        for name, value in start.items():
            value = value.to(self._rows[name])
            if numbers is not None:
                value = torch.zeros_like(self._rows[name]).index_copy(0, numbers, value)
            values[name] = value
            refused |= ~value.flatten(1).isfinite().all(dim=-1) if value.ndim > 1 else ~value.isfinite()
        _put(self._rows, mask, values)
        _put(self._rows, mask & refused, self._reference | {"refused": refused})

    def expand(self, name: str) -> Tensor:
        """Give a model field its own value per simulation: live ``(n, ...)`` values, float32.

        Raises:
            ValueError: no field that may differ, or one that mujoco_warp does not read as it is.
        """
        return self._fields.expand(name)

    def refresh(self, ids: Tensor | None = None) -> None:
        """Recompute the constants that MuJoCo derives from expanded fields (``mj_setConst``)."""
        derived = self._fields.derived()
        before = {} if ids is None else {name: x.clone() for name, x in derived.items()}
        self._launch("refresh", functools.partial(mjw.set_const, self._physics, self._data, restore=False))
        if ids is not None:
            _put(derived, ~self._mask(ids), before)

    def data(self, row: int) -> mujoco.MjData:  # pyright: ignore[reportAttributeAccessIssue]
        """One simulation as an ``MjData`` of its own with all derived fields, to be rendered; a stop."""
        model = self._fields.model_of(row)
        data = mj.MjData(model)
        data.time = float(self.time[row])
        for name in REMEMBERED:
            getattr(data, name)[...] = self._rows[name][row].cpu().numpy()
        mj.mj_forward(model, data)
        return data

    def save(self) -> dict[str, Tensor]:
        """Everything that decides the future, copied: rows, expanded fields, what was derived from them."""
        rows = torch.cat([x.reshape(self.num_envs, -1).double() for x in self._rows.values()], dim=-1)
        return {"rows": rows} | self._fields.save()

    def load(self, saved: dict[str, Tensor]) -> None:
        """Continue from :meth:`save`: bit for bit on the CPU.

        Raises:
            ValueError: the state belongs to another model, number of simulations or engine.
        """
        self.check(saved)
        fields = dict(saved)
        parts = fields.pop("rows").split([x[0].numel() for x in self._rows.values()], dim=-1)
        for x, part in zip(self._rows.values(), parts, strict=True):
            x.copy_(part.reshape(x.shape))
        self._fields.load(fields)
        self._diverged = torch.zeros_like(self._diverged)

    def check(self, saved: dict[str, Tensor]) -> None:
        """Raise ValueError unless :meth:`load` can continue from this."""
        alike = self._fields.alike(saved) if isinstance(saved, dict) else {}
        check_saved(saved, {"rows": self.save()["rows"]} | alike)


def _put(own: Mapping[str, Tensor], mask: Tensor, values: Mapping[str, Tensor]) -> None:
    """Give the rows of a mask these values, without asking which they are."""
    for name, x in own.items():
        if x.numel():
            x.copy_(torch.where(mask.view(-1, *[1] * (x.ndim - 1)), values[name], x))


def _room(model: Any) -> tuple[int, int]:
    """Contacts and constraints for which a simulation has room unless told otherwise."""
    limits = model.jnt_limited.sum() + model.tendon_limited.sum()
    frictions = (model.dof_frictionloss > 0).sum() + (model.tendon_frictionloss > 0).sum()
    always = int(2 * limits + frictions + 6 * model.neq)
    if model.opt.disableflags & mj.mjtDisableBit.mjDSBL_CONTACT:
        return 1, max(always, 1)
    return CONTACTS, CONSTRAINTS + always


def _device(device: Any) -> torch.device:
    """A device on which warp and torch can both work, with its number."""
    name = str(checks.instance("device", device, (str, torch.device)))
    if name == "cpu":
        return torch.device(name)
    present = [f"cuda:{number}" for number in range(torch.cuda.device_count())]
    if name == "cuda" and present:
        return torch.device(name, torch.cuda.current_device())
    if name not in present:
        raise ValueError(
            f"device: expected 'cpu', or 'cuda' where torch finds such a device (here {present}), got "
            f"{name!r}; install torch for CUDA, or take tasks.simulation.Simulation"
        )
    return torch.device(name)
