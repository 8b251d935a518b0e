"""By how much one joint is to be moved so that a link becomes the image of another.

Features of the link, such as its centre of mass, its shapes and the joints on it, propose angles: each
carries a feature of the link to the image of one of its kind. Each proposal is tried on all features.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from torchrl_sym.mujoco.derive.gaps import Gaps
from torchrl_sym.mujoco.model.types import HINGE, SLIDE, Array

_OFF_AXIS = 1e-2  # of a tree's size: what is nearer to the hinge says nothing about its angle
_SAME = 1e-7  # an angle better by less is no better
_EQUAL = 9  # decimals to which equal proposals are one: the rollers of a wheel propose each angle often
_AT_ONCE = 1 << 20  # distances of features that are taken at once

Features = list[tuple[tuple, Array]]  # what each is, and where


class Fit:
    """Fits a link, which hangs on one hinge or slide, to the image of another.

    Args:
        gaps: of the isometry, at the pose.
        a: the link whose image is looked for.
        b: the link that is moved.
    """

    def __init__(self, gaps: Gaps, a: int, b: int) -> None:
        self.gaps, self.parts, self.model = gaps, gaps.parts, gaps.parts.model
        self.matrix, self.a, self.b = gaps.matrix, a, b
        (self.joint,) = self.parts.links[b].joints
        self.axis, self.anchor = self.parts.axes[self.joint], self.parts.anchors[self.joint]
        self.size, self.hinge = self.parts.size(b), int(self.model.jnt_type[self.joint]) == HINGE
        self.aims = [(kind, self.matrix @ x) for kind, x in self._features(a)]
        self.own: dict[tuple, Array] = _by_kind(self._features(b))

    def move(self) -> float:
        """The move (rad or m) after which most of the link is where it should be."""
        moves = self._proposals()
        moves = moves[np.sort(np.unique(np.round(moves, _EQUAL), return_index=True)[1])]
        if len(moves) == 1:
            return float(moves[0])
        costs = self._costs(moves)
        return float(moves[np.flatnonzero(costs <= costs.min() + _SAME)[0]])

    def _features(self, a: int) -> Features:
        """Points of a link, and axes of the joints on it, with what they are."""
        parts, model, link = self.parts, self.model, self.parts.links[a]
        found: Features = [(("mass",), parts.centers[a])] if link.mass > 0 else []
        for child in link.children:
            for joint in parts.links[child].joints:
                kind = int(model.jnt_type[joint])
                found.append((("anchor", kind), parts.anchors[joint]))
                if kind in (HINGE, SLIDE):
                    found.append((("axis", kind), parts.axes[joint]))
        geoms = parts.skeleton.geoms.get(a, [])
        places = parts.data.geom_xpos[geoms] - parts.points[link.tree]
        kinds = zip(
            model.geom_type[geoms].tolist(), np.round(model.geom_size[geoms], 3).tolist(), strict=True
        )
        return found + [(("geom", kind, *size), x) for (kind, size), x in zip(kinds, places, strict=True)]

    def _proposals(self) -> Array:
        """Moves that are tried: none, to the middle of the range, and of each feature to its like."""
        model, (i,) = self.model, self.parts.links[self.a].joints
        j, moves = self.joint, [np.zeros(1)]
        if model.jnt_limited[i] and model.jnt_limited[j]:
            sign, middles = float(self.gaps.signs([(i, j)])[0]), model.jnt_range[[i, j]].mean(axis=1)
            start, end = self.parts.data.qpos[model.jnt_qposadr[[i, j]]]
            moves.append(middles[1:] - sign * middles[0] + sign * start - end)
        for kind, x in self.aims:
            if kind in self.own:
                moves.append(self._between(x, self.own[kind], kind[0] == "axis"))
        return np.concatenate(moves)

    def _between(self, x: Array, features: Array, free: bool) -> Array:
        """Moves that carry features to x: of points, or of free vectors up to their sign."""
        axis, anchor = self.axis, np.zeros(3) if free else self.anchor
        if not self.hinge:
            return np.zeros(0) if free else (x - features) @ axis
        arms = np.concatenate([x[None], features]) - anchor
        arms = arms - (arms @ axis)[:, None] * axis
        lengths = np.linalg.norm(arms, axis=1)
        length, others = lengths[0], lengths[1:]
        tells = np.minimum(length, others) >= _OFF_AXIS * (1.0 if free else self.size)
        tells &= np.abs(length - others) <= 0.1 * np.maximum(length, others)
        one, other = arms[0], arms[1:][tells]
        angle = np.arctan2(np.cross(other, one) @ axis, other @ one)
        return np.stack([angle, angle - np.copysign(np.pi, angle)], axis=1).ravel() if free else angle

    def _costs(self, moves: Array) -> Array:
        """How far the link, moved, is from where it should be, for every move."""
        matrix, turns = self.matrix, _about(self.axis, moves if self.hinge else np.zeros_like(moves))
        inertia = matrix @ self.parts.inertias[self.a] @ matrix.T
        gap = inertia - turns @ self.parts.inertias[self.b] @ turns.swapaxes(1, 2)
        scale = max(float(np.trace(inertia)), 1e-12)
        costs = np.abs(gap).max(axis=(1, 2)) / scale + 1e-6 * np.abs(moves)
        for kind, aims in _by_kind(self.aims).items():
            if kind[0] == "anchor":  # a hinge's anchor may be anywhere on its axis
                continue
            if kind not in self.own:
                costs += len(aims)
                continue
            own = self.own[kind]
            step = max(_AT_ONCE // (len(own) * len(aims)), 1)
            for start in range(0, len(moves), step):
                some = slice(start, start + step)
                costs[some] += self._apart(kind, aims, own, turns[some], moves[some])
        return costs

    def _apart(self, kind: tuple, aims: Array, own: Array, turns: Array, moves: Array) -> Array:
        """Sum over features of one kind of how far the nearest, moved, is from each aim, ``(moves,)``."""
        if kind[0] == "axis":
            return (1 - np.abs(own @ turns.swapaxes(1, 2) @ aims.T)).min(axis=1).sum(axis=1)
        if self.hinge:
            moved = self.anchor + (own - self.anchor) @ turns.swapaxes(1, 2)
        else:
            moved = own + moves[:, None, None] * self.axis
        gaps = moved[:, :, None] - aims
        return np.sqrt((gaps * gaps).sum(axis=-1)).min(axis=1).sum(axis=1) / self.size


def _by_kind(features: Features) -> dict[tuple, Array]:
    found: dict[tuple, list[Array]] = defaultdict(list)
    for kind, x in features:
        found[kind].append(x)
    return {kind: np.array(some) for kind, some in found.items()}


def _about(axis: Array, angles: Array) -> Array:
    """Turns about an axis, ``(n, 3, 3)``."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sines, versed = np.sin(angles)[:, None, None], (1 - np.cos(angles))[:, None, None]
    return np.eye(3) + sines * cross + versed * (cross @ cross)
