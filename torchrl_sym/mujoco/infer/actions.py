"""How actions transform: K_g, from what actions do.

In a state s, action entry j changes the controls by column j of a matrix E(s). If the controls of the image
are the image of the controls, then E(L_g s) K_g = P_g E(s), with P_g what `derive` finds for controls: one
system of equations for K_g, whatever subset, order, unit or mixture of the controls the actions are. Where
actions move something else (a mocap body, forces), the same holds of the next state.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.infer.columns import Flags
from torchrl_sym.mujoco.infer.errors import InferenceError, Unexplained
from torchrl_sym.mujoco.infer.mixing import polished
from torchrl_sym.mujoco.infer.samples import box_of, random_action
from torchrl_sym.mujoco.model.types import Array, name_of
from torchrl_sym.mujoco.verify.subjects import Subject
from torchrl_sym.representations import Representation

_STATES = 2  # states in which every action is tried
_STILL = 1e-9  # change that is no more than rounding
_STEP = 0.25  # of the way from the middle of the box to its end
_ORTHOGONAL = 1e-3  # distance from orthogonal that is still taken for noise
_CLIPPED = 1e-6  # relative difference of controls that counts
_STATE_NOISE = 1e-3  # the same of a next state, which contact may amplify
_REMEDY = (
    "declare the action yourself, Symmetry(group, {..., 'action': ...}); make actions relative to a "
    "symmetric pose, with equal limits and gains on both sides; or take another group"
)


class ActionFinder:
    """Finds K_g of an environment.

    Attributes:
        still: action entries that move nothing.
    """

    def __init__(self, subject: Subject, group: PointGroup, generator: torch.Generator) -> None:
        self.subject, self.group, self.generator = subject, group, generator
        self.size = len(subject.low)
        low, high = box_of(subject)
        self.middle, self.reach = (low + high) / 2, (high - low) / 2 * _STEP
        self.still: list[int] = []

    def find(self) -> Representation:
        """The representation of the action.

        Raises:
            InferenceError: no action makes a difference, or no orthogonal K_g explains what they do.
        """
        if not self.size:
            raise InferenceError("'action': expected actions, got none; there is nothing to transform")
        starts = [self._start(i) for i in range(_STATES)]
        controls = self._effects(starts, True, range(self.group.order))
        moved = None if controls is None else _moves(controls[0][0])
        if controls is not None and moved is not None and not moved.all():
            other = self._effects(starts, False, [0])  # do the rest move anything else?
            if other is not None and (_moves(other[0][0]) & ~moved).any():
                controls = None
        effects = controls or self._effects(starts, False, range(self.group.order))
        if effects is None:
            raise InferenceError("'action': no action can be followed; " + _REMEDY)
        self.still = np.flatnonzero(~_moves(effects[0][0])).tolist()
        return self._solved(starts, effects, controls is not None)

    def labels(self) -> list[str]:
        """Names of the actuators, where there is one for each action."""
        model = self.subject.model
        return [name_of(model, "actuator", i) for i in range(model.nu)] if model.nu == self.size else []

    def _start(self, number: int) -> Any:
        """States from resets, by a few random actions."""
        self.subject.reset()
        for _ in range(2 * number):
            self.subject.step(random_action(self.subject, self.generator))
        return self.subject.state()

    def _after(self, state: Any, action: Tensor, of_controls: bool) -> tuple[Tensor, Any]:
        """The controls, and the state, after an action from a state."""
        self.subject.begin(state)
        out = self.subject.step(action.expand(self.subject.rows, -1))
        return out.ctrl, None if of_controls else self.subject.state()

    def _mapped(self, after: tuple[Tensor, Any], g: int) -> Tensor | None:
        """What an action led to, mapped, as one vector."""
        ctrl, state = after
        parts = [] if not ctrl.shape[-1] else [self.subject.map_ctrl(ctrl, g)]
        if parts and parts[0] is None and state is None:
            return None
        parts = [x for x in parts if x is not None]
        if state is not None:
            image = self.subject.transform(state, g)
            moved = (image.qvel, getattr(image, "mocap_pos", None), getattr(image, "mocap_quat", None))
            parts += [x.flatten(1) for x in moved if x is not None]
        return torch.cat(parts, 1).flatten() if parts else None

    def _effects(
        self, starts: list[Any], of_controls: bool, elements: Iterable[int]
    ) -> list[tuple[Array, Array]] | None:
        """For each element: E(L_g s), and the image of E(s); None if nobody knows the image."""
        out = []
        tried = [self._tried(state, of_controls) for state in starts]
        for g in elements:
            there, here = [], []
            for state, before in zip(starts, tried, strict=True):
                after = before if g == 0 else self._tried(self.subject.transform(state, g), of_controls)
                pair = self._columns(after, 0), self._columns(before, g)
                if pair[0] is None or pair[1] is None:
                    return None
                there.append(pair[0])
                here.append(pair[1])
            out.append((np.concatenate(there), np.concatenate(here)))
        return out

    def _tried(self, state: Any, of_controls: bool) -> list[tuple[Tensor, Any]]:
        """What follows from the middle of the box, and from a change of each action entry."""
        changes = [torch.zeros(self.size, dtype=torch.float64), *torch.diag(self.reach)]
        return [self._after(state, self.middle + change, of_controls) for change in changes]

    def _columns(self, tried: list[tuple[Tensor, Any]], g: int) -> Array | None:
        """Change of what follows, mapped, per change of each action entry."""
        base, *moved = (self._mapped(after, g) for after in tried)
        if base is None:
            return None
        columns = [x - base for x in moved if x is not None]
        return (torch.stack(columns, 1) / self.reach.clamp(min=1e-12)).numpy()

    def _solved(
        self, starts: list[Any], effects: list[tuple[Array, Array]], of_controls: bool
    ) -> Representation:
        moving = [j for j in range(self.size) if j not in self.still]
        if not moving:
            raise InferenceError(
                "'action': no action makes a difference in the states that were tried, so that nothing "
                "tells how it transforms; are the actuators without gain, or the limits of actions zero?"
            )
        matrices = np.zeros((self.group.order, self.size, self.size))
        matrices[:, self.still, self.still] = 1.0
        for g, (there, here) in enumerate(effects):
            part = np.linalg.lstsq(there[:, moving], here[:, moving], rcond=1e-9)[0]
            whole = np.round(part)
            part = np.where(np.abs(part - whole) < _ORTHOGONAL, whole, part)
            matrices[np.ix_([g], moving, moving)] = part
        gap = np.abs(matrices @ matrices.swapaxes(1, 2) - np.eye(self.size)).max(axis=2)
        if (gap > 10 * _ORTHOGONAL).any():
            self._refuse(gap, "its effect is not that of any other entry, turned or exchanged")
        matrices = polished(self.group, matrices)
        try:
            action = Representation(self.group, torch.as_tensor(matrices))
        except ValueError as error:
            raise InferenceError(f"'action': {error}; {_REMEDY}") from error
        self._check(starts, action, of_controls)
        return action

    def _check(self, starts: list[Any], action: Representation, of_controls: bool) -> None:
        """The controls of K_g a in L_g s are the image of those of a in s, for random a."""
        limit = _CLIPPED if of_controls else _STATE_NOISE
        for state in starts:
            a = random_action(self.subject, self.generator)[0]
            for g, element in enumerate(self.group.names):
                expected = self._mapped(self._after(state, a, of_controls), g)
                start = self.subject.transform(state, g)
                got = self._mapped(self._after(start, action(a, g), of_controls), 0)
                assert expected is not None and got is not None
                gap = (expected - got).abs() / expected.abs().clamp(min=1.0)
                if gap.max() > limit:
                    i = int(gap.argmax())
                    what = "control" if of_controls else "coordinate"
                    raise InferenceError(
                        f"'action': under {element!r}, {what} {i % max(self.subject.model.nu, 1)} of the "
                        f"mirrored action is {float(got[i]):.4g}, expected {float(expected[i]):.4g}: the "
                        f"action has an offset, a limit or a scale that differs from its image's; {_REMEDY}"
                    )

    def _refuse(self, gap: Array, reason: str) -> None:
        faults = [
            Unexplained("action", int(i), "", self.group.names[int(g)], float(gap[g, i]), reason)
            for g, i in np.argwhere(gap > 10 * _ORTHOGONAL)
        ]
        raise InferenceError(f"'action' does not transform orthogonally; {_REMEDY}:", faults)


def _moves(effects: Array) -> Flags:
    """Which actions make a difference, by the columns of their effects."""
    size = np.linalg.norm(effects, axis=0)
    return size > _STILL * max(float(size.max(initial=0.0)), 1.0)
