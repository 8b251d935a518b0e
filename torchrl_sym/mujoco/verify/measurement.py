"""Comparing what follows from a state with what follows from its images."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy import stats
from tensordict import TensorDict
from torch import Tensor

from torchrl_sym.mujoco.model.types import BALL, FREE, Array, MjModel, mj, name_of
from torchrl_sym.mujoco.verify.poses import can_touch
from torchrl_sym.mujoco.verify.report import VerifyRow
from torchrl_sym.mujoco.verify.states import touches, write_state
from torchrl_sym.mujoco.verify.subjects import Observation, Outcome, Subject
from torchrl_sym.symmetry import Symmetry

RESETS = 400  # starts in each of the two samples that are compared
SIGNIFICANCE = 1e-3  # chance that a symmetric start distribution fails, over all entries and elements
FLOAT32_TOLERANCE = 2e-6  # rounding of observations and rewards in single precision


@dataclass
class Trajectory:
    """What followed from a state, after one step and after many."""

    start: Any  # states
    before: Observation
    first: Outcome
    one: Any
    many: Any


@dataclass
class Measurement:
    """Collects the worst residual of every part, element and entry group."""

    subject: Subject
    symmetry: Symmetry
    tolerance: float
    steps: int
    raw_rows: int  # how many rows of a batch go through mj_step one by one
    warm_up: int  # random actions before a state is tested, at most
    generator: torch.Generator
    rows: dict[tuple[str, str, str], VerifyRow] = field(default_factory=dict)
    states_tested: int = 0
    contacts: int = 0
    moved: set[int] = field(default_factory=set)  # elements that change something observed or done
    exercised: bool = False  # whether any action changed anything
    reachable: bool = True  # whether contact is, as far as a search tells

    def __post_init__(self) -> None:
        self.group, self.action = self.symmetry.group, self.symmetry["action"]
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
        self.subject.reset()
        count = torch.randint(self.warm_up + 1, (self.subject.rows,), generator=self.generator)
        for step in range(int(count.max())):
            out = self.subject.step(self.random_action(), count > step)
            count[out.terminated | out.truncated] = 0  # an episode ends here
        self.compare_from(self.subject.state())

    def add_contacts(self, count: int) -> None:
        """The same from states in contact, wherever they come from, if there were none."""
        if self.contacts or not can_touch(self.subject.model):
            return
        for _ in range(count):
            self.subject.reset()
            start = self.subject.touching(self.generator)
            if start is None:
                self.reachable = self.subject.searches == 0
                break
            self.compare_from(start)

    def compare_from(self, start: Any) -> None:
        actions = [self.random_action() for _ in range(self.steps)]
        original = self.run(start, actions)
        if not self.exercised:
            self.exercised = self.responds(start, actions[0], original)
        self.states_tested += self.raw_rows
        self.contacts += sum(touches(self.subject.model, start, row) for row in range(self.raw_rows))
        for g, element in enumerate(self.group.names):
            images = [self.action(a, g) for a in actions]
            if not torch.equal(images[0], actions[0]):
                self.moved.add(g)
            image = self.run(self.subject.transform(start, g), images)
            self.compare(original, image, g, element)

    def responds(self, start: Any, action: Tensor, original: Trajectory) -> bool:
        """Whether another action makes a difference."""
        if torch.equal(other := self.random_action(), action):
            return False
        self.subject.load(start)
        out, state = self.subject.step(other), self.subject.state()
        pairs = [(out.ctrl, original.first.ctrl)]
        pairs += [(getattr(state, x), getattr(original.one, x)) for x in ("qpos", "qvel", "mocap_pos")]
        return any(a is not None and not torch.equal(a, b) for a, b in pairs)

    def run(self, start: Any, actions: list[Tensor]) -> Trajectory:
        subject = self.subject
        before = self.declared(subject.load(start))
        first = subject.step(actions[0])
        first.observation = self.declared(first.observation)
        one = subject.state()
        for action in actions[1:]:
            subject.step(action)
        return Trajectory(start, before, first, one, subject.state())

    def declared(self, observation: Observation) -> Observation:
        """Entries that the symmetry declares, in the shape of its events."""
        if self.symmetry.strict:
            self.symmetry.require(observation, "verify")
        found = {key: x for key, x in observation.items() if key in self.symmetry}
        for key, x in found.items():
            if len(self.symmetry.together([key])) > 1:
                continue  # mapped, and checked, with the entries it changes places with
            representation, size = self.symmetry[key], x[0].numel()
            if size != representation.dim:
                raise ValueError(
                    f"{key!r}: the environment observes {size} entries, its representation has "
                    f"{representation.dim}; list every entry in order{self.subject.hint}"
                )
            found[key] = x.reshape(len(x), *representation.event_shape)
        return found

    def images(self, observation: Observation, g: int) -> Observation:
        """L_g of what is observed."""
        rows = len(next(iter(observation.values()), ()))
        batch = TensorDict(observation, batch_size=[rows])  # pyright: ignore[reportArgumentType]
        image = self.symmetry(batch, g, keys=list(observation))
        return {key: image[key] for key in observation}

    def compare(self, original: Trajectory, image: Trajectory, g: int, element: str) -> None:
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
        expected = self.images(original, g)
        for key, value in original.items():
            if not torch.equal(expected[key], value):
                self.moved.add(g)
            residual = _residual(expected[key], image[key]).max(axis=0, initial=0.0)
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
        images = self.action.image_of_box(*box)
        for g, element in enumerate(self.group.names):
            pairs = zip(images, box, strict=True)
            gap = np.maximum(*(torch.where(a[g] == b, 0.0, (a[g] - b).abs()).numpy() for a, b in pairs))
            limit = max(self.tolerance, 1e-6)  # bounds are single precision in most specs
            self.note("action box", element, gap.max(initial=0.0), limit, _entries("action", gap, limit))

    def resets(self) -> None:
        """Two-sample Kolmogorov-Smirnov test of every entry of L_g x against independent x."""
        one, other = self.starts(), self.starts()
        entries = sum(x[0].numel() for x in one.values())
        tests = max(entries * (self.group.order - 1), 1)
        limit = float(stats.kstwo.isf(SIGNIFICANCE / tests, RESETS // 2))
        scales = {key: y.double().flatten(1).abs().amax(dim=0).clamp(min=1.0) for key, y in other.items()}
        for g in range(1, self.group.order):
            images = self.images(one, g)
            for key, scale in scales.items():
                pair = images[key], other[key]
                a, b = ((z.double().flatten(1) / scale).round(decimals=5).numpy() + 0.0 for z in pair)
                columns = zip(a.T, b.T, strict=True)
                distance = np.array(
                    [stats.ks_2samp(u, v, method="asymp").statistic for u, v in columns]  # pyright: ignore[reportAttributeAccessIssue]
                )
                where = _entries(str(key), distance, limit)
                self.note("reset", self.group.names[g], distance.max(initial=0.0), limit, where, str(key))

    def starts(self) -> Observation:
        count = math.ceil(RESETS / self.subject.rows)
        batches = [self.declared(self.subject.reset()) for _ in range(count)]
        return {key: torch.cat([batch[key] for batch in batches])[:RESETS] for key in batches[0]}

    def untested(self) -> list[str]:
        """What nothing above says anything of."""
        still = [name for g, name in enumerate(self.group.names) if g and g not in self.moved]
        out = [f"{name} moves no entry of the observation or the action" for name in still]
        model = self.subject.model
        if (model.nu or model.nmocap) and not self.exercised:  # else nothing can be driven
            out.append("no action makes a difference")
        if not self.contacts and self.reachable and can_touch(model):
            out.append("contact was never reached")
        return out


def _residual(expected: Tensor, got: Tensor) -> Array:
    """|difference| of every row and entry, relative to the entry's largest value or 1."""
    a, b = (x.double().flatten(1).numpy() for x in (expected, got))
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
