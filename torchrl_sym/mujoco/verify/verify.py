"""Verify a symmetry on an environment: does the simulation agree with the signs somebody wrote down?

For each element g, with L_g and K_g of the paper, a symmetric task satisfies::

    obs(L_g s) = L_g obs(s),   T(L_g s, K_g a) = L_g T(s, a),   r(L_g s, K_g a) = r(s, a)

and its starts are distributed symmetrically. `verify` measures all of it at states that the environment
reaches, and says which part is wrong, and where: an entry of an observation, a joint, the reward.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from torchrl_sym import checks
from torchrl_sym.mujoco.model.types import BALL, FREE, Array, MjModel, mj, name_of
from torchrl_sym.mujoco.verify.remembered import Remembered, remembered
from torchrl_sym.mujoco.verify.report import PARTS, VerifyReport, VerifyRow
from torchrl_sym.mujoco.verify.subjects import Observation, Outcome, Pose, Subject, subject_of, write_state
from torchrl_sym.representations import Representation
from torchrl_sym.symmetry import Symmetry, check_symmetry

MAX_WARM_UP = 50  # random actions before a state is tested
MOST = 100_000  # states, or steps: more would take days
RESETS = 400  # starts in each of the two samples that are compared
SIGNIFICANCE = 1e-3  # chance that a symmetric start distribution fails, over all entries and elements
FLOAT32_TOLERANCE = 2e-6  # rounding of observations and rewards in single precision


def verify(
    env: Any,
    symmetry: Symmetry,
    *,
    keyframe: int | str | None = None,
    carried: Sequence[str] = (),
    states: int = 16,
    steps: int = 10,
    tolerance: float = 1e-8,
    seed: int = 0,
    observe: Callable[[Any], Any] | None = None,
    memory: Mapping[str, Representation] | Remembered | None = None,
) -> VerifyReport:
    """Measure how far an environment is from the symmetry declared for it.

    The states are reached from resets by up to 50 random actions. From each of them and from its images
    the environment is stepped with random actions and their images. The identity is tested too: it fails
    if something that decides the future is not part of the state, and the report then says "not tested"
    before all else. The parts, in the order of cause:

    - ``"action box"``: K_g maps the bounds of the actions onto themselves, by entry;
    - ``"dynamics"``: one ``mj_step`` of the model with contact switched off, by joint;
    - ``"contact"``: one step of the environment with everything switched on, by joint; if this fails
      and ``"dynamics"`` does not, contact is to blame;
    - ``"kinematics"``: the observation of the image is the image of the observation, by entry;
    - ``"reward"``, ``"termination"`` and ``"next observation"`` of that step, the last with what the
      environment remembers then;
    - ``"rollout"``: the state after ``steps`` steps, by joint; reported, never a failure, since contact
      amplifies rounding;
    - ``"reset"``: Kolmogorov-Smirnov distance between mapped and other start observations, by entry.

    Args:
        env: a batched task environment (``reset_to``, ``task.transform_state``), a dm_control
            ``Environment`` or a gymnasium ``MujocoEnv``, these also inside TorchRL's wrappers. It is reset,
            seeded and stepped. Of the last two the state of MuJoCo is mapped, through
            :func:`~torchrl_sym.mujoco.derive`, and ``memory``: a target that the task keeps elsewhere,
            such as a moved geom, stays put and shows as a residual.
        symmetry: representations of the observation's entries (``"observation"`` for an array) and of
            ``"action"``. If it is not strict, entries it does not declare are not tested.
        keyframe: symmetric pose for ``derive``. Defaults to ``qpos0``.
        carried: bodies that a turn of the world only carries along, for ``derive``. A batched task
            environment maps its state itself and needs neither.
        states: number of states, rounded up to whole batches; of a batch larger than this, contact-free
            dynamics are tested on so many rows.
        steps: length of the roll-outs.
        tolerance: largest relative residual that passes; 2e-6 for single-precision outputs.
        seed: seed of states and actions.
        observe: applied to every observation before it is compared, such as a normaliser.
        memory: what the environment remembers beside the state of MuJoCo (last actions, a history, a
            phase): attributes of it that hold arrays, with their representations; or
            :class:`~torchrl_sym.mujoco.Remembered`, with functions that save and load.

    Raises:
        TypeError: an environment of another kind, or memory that is no array.
        KeyError: an observation, the action, or something remembered is not declared, or not there.
        ValueError: a size or group differs from its representation's; a number out of its range; or a
            keyframe, carried bodies or memory for a task environment, which would ignore them.
        SymmetryError: the model does not have the group, or a body cannot be carried by an element.

    Example:
        >>> import tasks
        >>> env = tasks.make_env("cartpole", num_envs=16, num_threads=1)
        >>> verify(env, env.symmetry).passed
        True

        Of a gymnasium environment that observes its last two actions, as ``env.last`` and ``env.last2``::

            verify(env, symmetry, memory={"last": robot.actuators, "last2": robot.actuators})
    """
    check_symmetry(symmetry)
    kept = remembered(memory)
    if kept is not None:
        kept.check_group(symmetry.group)
    states, steps = (checks.whole(n, x, 1, MOST) for n, x in (("states", states), ("steps", steps)))
    tolerance = checks.real("tolerance", tolerance, 0.0)
    seed = checks.whole("seed", seed, 0, 2**32 - 1)  # what NumPy takes
    if observe is not None:
        checks.function("observe", observe)
    subject = subject_of(env, symmetry, observe, Pose(keyframe, carried), seed, kept)
    if symmetry["action"].dim != len(subject.low):
        raise ValueError(
            f"'action': the environment takes {len(subject.low)} entries, its representation has "
            f"{symmetry['action'].dim}; list every actuator in order"
        )
    generator = torch.Generator().manual_seed(seed)
    check = _Check(subject, tolerance, steps, states, generator)
    for _ in range(math.ceil(states / subject.rows)):
        check.add_state()
    check.action_box()
    check.resets()
    rows = sorted(check.rows.values(), key=lambda row: PARTS.index(row.part))
    return VerifyReport(rows, check.states_tested, check.contacts, symmetry.group.names[0])


@dataclass
class _Trajectory:
    start: Any  # states
    before: Observation
    first: Outcome
    one: Any
    many: Any


@dataclass
class _Check:
    """Collects the worst residual of every part, element and entry group."""

    subject: Subject
    tolerance: float
    steps: int
    raw_rows: int  # how many rows of a batch go through mj_step one by one
    generator: torch.Generator
    rows: dict[tuple[str, str, str], VerifyRow] = field(default_factory=dict)
    states_tested: int = 0
    contacts: int = 0

    def __post_init__(self) -> None:
        self.group = self.subject.symmetry.group
        self.free = copy.copy(self.subject.model)  # the same model without contact
        self.free.opt.disableflags |= int(mj.mjtDisableBit.mjDSBL_CONTACT)
        self.labels = _coordinate_labels(self.subject.model)
        self.raw_rows = min(self.raw_rows, self.subject.rows)

    def random_action(self) -> Tensor:
        low, high = (x.clamp(-1e3, 1e3) for x in (self.subject.low, self.subject.high))
        shape = (self.subject.rows, len(low))
        return low + (high - low) * torch.rand(shape, generator=self.generator, dtype=torch.float64)

    def add_state(self) -> None:
        """Compare the trajectories from one reachable state (per row) and from its images."""
        subject, action = self.subject, self.subject.symmetry["action"]
        subject.reset()
        count = torch.randint(MAX_WARM_UP + 1, (subject.rows,), generator=self.generator)
        for step in range(int(count.max())):
            out = subject.step(self.random_action(), count > step)
            count[out.terminated | out.truncated] = 0  # an episode ends here
        start = subject.state()
        actions = [self.random_action() for _ in range(self.steps)]
        original = self.run(start, actions)
        self.count_contacts(start)
        for g, element in enumerate(self.group.names):
            image = self.run(subject.transform(start, g), [action(a, g) for a in actions])
            self.compare(original, image, g, element)

    def run(self, start: Any, actions: list[Tensor]) -> _Trajectory:
        subject = self.subject
        before = subject.load(start)
        first = subject.step(actions[0])
        one = subject.state()
        for action in actions[1:]:
            subject.step(action)
        return _Trajectory(start, before, first, one, subject.state())

    def count_contacts(self, start: Any) -> None:
        data = mj.MjData(self.subject.model)
        self.states_tested += self.raw_rows
        for row in range(self.raw_rows):
            write_state(data, start, row)
            mj.mj_fwdPosition(self.subject.model, data)
            self.contacts += bool(data.ncon > 0)

    def compare(self, original: _Trajectory, image: _Trajectory, g: int, element: str) -> None:
        self.observations("kinematics", original.before, image.before, g)
        some = slice(0, self.raw_rows)
        expected = self.step_freely(original.start.rows(some), original.first.ctrl)
        got = self.step_freely(image.start.rows(some), image.first.ctrl)
        self.states("dynamics", expected, got, g)
        self.states("contact", original.one, image.one, g)
        self.states("rollout", original.many, image.many, g, math.inf)
        one, other = original.first, image.first
        value = _residual(one.reward[:, None], other.reward[:, None])
        row = int(np.argmax(value.max(axis=1)))
        pair = f"r(s, a) = {float(one.reward[row]):.4g}, r(gs, ga) = {float(other.reward[row]):.4g}"
        self.note("reward", element, value.max(), self.limit(one.reward), pair)
        for flag in ("terminated", "truncated"):
            differ = getattr(one, flag) != getattr(other, flag)
            self.note("termination", element, float(differ.double().mean()), 0.0, flag, flag)
        self.observations("next observation", one.observation, other.observation, g)
        self.memory("next observation", original.one, image.one, g)

    def limit(self, values: Tensor) -> float:
        single = values.dtype in (torch.float32, torch.float16, torch.bfloat16)
        return max(self.tolerance, FLOAT32_TOLERANCE) if single else self.tolerance

    def note(self, part: str, element: str, value: Any, limit: float, where: str, group: str = "") -> None:
        """Keep the worst row of every part, element and group of entries."""
        key = (part, element, group)
        if key not in self.rows or float(value) > self.rows[key].value:
            self.rows[key] = VerifyRow(part, element, float(value), limit, where)

    def observations(self, part: str, original: Observation, image: Observation, g: int) -> None:
        for key, value in original.items():
            expected = self.subject.symmetry[key](value, g)
            residual = _residual(expected, image[key]).max(axis=0)
            limit = self.limit(value)
            where = _entries(str(key), residual, limit)
            self.note(part, self.group.names[g], residual.max(initial=0.0), limit, where, str(key))

    def memory(self, part: str, original: Any, image: Any, g: int) -> None:
        expected = getattr(self.subject.transform(original, g), "memory", {})
        for name, value in expected.items():
            one, other = (torch.as_tensor(x).reshape(1, -1) for x in (value, image.memory[name]))
            residual, limit = _residual(one, other).max(axis=0), self.limit(one)
            label = f"memory {name}"
            where = _entries(label, residual, limit)
            self.note(part, self.group.names[g], residual.max(initial=0.0), limit, where, label)

    def step_freely(self, state: Any, ctrl: Tensor) -> Any:
        """One ``mj_step`` without contact."""
        for row in range(len(state.qpos)):
            data = mj.MjData(self.free)
            write_state(data, state, row)
            data.ctrl[:] = ctrl[row].numpy()
            mj.mj_step(self.free, data)
            state.qpos[row] = torch.as_tensor(np.array(data.qpos))
            state.qvel[row] = torch.as_tensor(np.array(data.qvel))
        return state

    def states(self, part: str, original: Any, image: Any, g: int, limit: float | None = None) -> None:
        expected = self.subject.transform(original, g)
        turned = _same_sign(self.subject.model, expected.qpos, image.qpos)
        residual = np.concatenate(
            [_residual(expected.qpos, turned), _residual(expected.qvel, image.qvel)], axis=1
        ).max(axis=0)
        worst = int(residual.argmax())
        limit = self.tolerance if limit is None else limit
        self.note(part, self.group.names[g], residual[worst], limit, self.labels[worst])

    def action_box(self) -> None:
        box = self.subject.low, self.subject.high
        images = self.subject.symmetry["action"].image_of_box(*box)
        for g, element in enumerate(self.group.names):
            pairs = zip(images, box, strict=True)
            gap = np.maximum(*(torch.where(a[g] == b, 0.0, (a[g] - b).abs()).numpy() for a, b in pairs))
            limit = max(self.tolerance, 1e-6)  # bounds are single precision in most specs
            self.note("action box", element, gap.max(initial=0.0), limit, _entries("action", gap, limit))

    def resets(self) -> None:
        """Two-sample Kolmogorov-Smirnov test of every entry of L_g x against independent x."""
        one, other = self.starts(), self.starts()
        entries = sum(x.shape[-1] for x in one.values())
        tests = max(entries * (self.group.order - 1), 1)
        limit = float(stats.kstwo.isf(SIGNIFICANCE / tests, RESETS // 2))
        for key, x in one.items():
            y = other[key].double()
            scale = y.abs().amax(dim=0).clamp(min=1.0)
            for g in range(1, self.group.order):
                image = self.subject.symmetry[key](x.double(), g)
                a, b = ((z / scale).round(decimals=5).numpy() + 0.0 for z in (image, y))
                pairs = zip(a.T, b.T, strict=True)
                distance = np.array([stats.ks_2samp(u, v, method="asymp").statistic for u, v in pairs])  # pyright: ignore[reportAttributeAccessIssue]
                where = _entries(str(key), distance, limit)
                self.note("reset", self.group.names[g], distance.max(), limit, where, str(key))

    def starts(self) -> Observation:
        batches = [self.subject.reset() for _ in range(math.ceil(RESETS / self.subject.rows))]
        return {key: torch.cat([batch[key] for batch in batches])[:RESETS] for key in batches[0]}


def _residual(expected: Tensor, got: Tensor) -> Array:
    """|difference| of every row and entry, relative to the entry's largest value or 1."""
    a, b = expected.double().numpy(), got.double().numpy()
    scale = np.maximum(np.abs(np.nan_to_num(a)).max(axis=0, initial=0.0), 1.0)
    return np.nan_to_num(np.abs(a - b) / scale, nan=np.inf)


def _entries(key: str, residual: Array, limit: float) -> str:
    """The worst entry, and the range of all entries beyond the limit."""
    if not residual.size:
        return key
    wrong = np.flatnonzero(residual > limit)
    worst = f"{key}[{int(residual.argmax())}]"
    if len(wrong) < 2:
        return worst
    runs = np.split(wrong, np.flatnonzero(np.diff(wrong) > 1) + 1)
    text = ", ".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)
    return f"{worst} (wrong: {text})"


def _coordinate_labels(model: MjModel) -> list[str]:
    """Names of all entries of qpos, then of qvel, by their joint."""
    labels = []
    for kind, size, starts in (("qpos", model.nq, model.jnt_qposadr), ("qvel", model.nv, model.jnt_dofadr)):
        ends = [*starts[1:], size]
        for j, (start, end) in enumerate(zip(starts, ends, strict=True)):
            name = f"joint {name_of(model, 'joint', j)}, {kind}"
            labels += [name] if end - start == 1 else [f"{name}[{i}]" for i in range(end - start)]
    return labels


def _same_sign(model: MjModel, expected: Tensor, qpos: Tensor) -> Tensor:
    """Positions with every quaternion q replaced by -q where that is nearer to the expected one."""
    qpos = qpos.clone()
    for j in range(model.njnt):
        kind = int(model.jnt_type[j])
        if kind in (BALL, FREE):
            first = int(model.jnt_qposadr[j]) + (3 if kind == FREE else 0)
            block = slice(first, first + 4)
            opposite = (qpos[:, block] * expected[:, block]).sum(-1, keepdim=True) < 0
            qpos[:, block] = torch.where(opposite, -qpos[:, block], qpos[:, block])
    return qpos
