"""A pose that a group keeps, where a model's file has none.

Encoders are zeroed where they happened to be: a leg's zero may be its hanging pose on the left and a raised
one on the right. Whether the legs are mirror images does not depend on that. From the root to the leaves,
once a link's parent is in place, its joint's anchor and axis are; what is left is one angle. It is read off
the link itself: from its centre of mass, its shapes, the joints on it, or the middles of the ranges, by
trying each and keeping the one at which most of the link is where its image should be.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.derive.pairing import Pairing
from torchrl_sym.mujoco.derive.parts import Parts
from torchrl_sym.mujoco.model.links import is_loose
from torchrl_sym.mujoco.model.poses import Pose, kinematics
from torchrl_sym.mujoco.model.types import HINGE, SLIDE, Array, MjModel

_OFF_AXIS = 1e-2  # of a tree's size: what is nearer to the hinge says nothing about its angle
_SAME = 1e-7  # an angle better by less is no better


def solved(
    model: MjModel, group: PointGroup, pose: Pose, axis: Array, carried: frozenset[int], tolerance: float
) -> Pose | None:
    """The pose with hinges and slides moved so that the group keeps it; None if that does not help."""
    return _Solver(model, group, pose, axis, carried, tolerance).solve()


class _Hopeless(Exception):
    """A joint has no image, wherever the joints are that it does not hang on."""


class _Solver:
    def __init__(
        self,
        model: MjModel,
        group: PointGroup,
        pose: Pose,
        axis: Array,
        carried: frozenset[int],
        tolerance: float,
    ) -> None:
        self.model, self.group, self.pose, self.axis, self.carried = model, group, pose, axis, carried
        self.tolerance = tolerance
        self.qpos = pose.qpos.copy()
        self.settled: set[int] = set()
        self.images: list[dict[int, int]] = [{0: 0} for _ in range(group.order)]

    def solve(self) -> Pose | None:
        try:
            queue = [self._siblings(self._parts(), 0)]
            while queue:
                for a in queue.pop(0):
                    self._settle(a)
                    queue.append(self._siblings(self._parts(), a))
        except _Hopeless:
            return None
        return self.pose.at(self.qpos, f"{self.pose.words}, with joints moved to where they are symmetric")

    def _parts(self) -> Parts:
        parts = Parts.of(self.model, kinematics(self.model, self.pose.at(self.qpos)), self.carried)
        return parts.about({b: self.axis for b in parts.fixed})

    def _siblings(self, parts: Parts, a: int) -> list[int]:
        """Children of a link; finds their images under every element."""
        mine = [c for c in parts.links[a].children if c not in self.carried]
        for images, matrix in zip(self.images, self.group.matrices.numpy(), strict=True):
            if a not in images:
                continue
            theirs = [c for c in parts.links[images[a]].children if c not in self.carried]
            pairing = Pairing(parts, matrix)
            table = np.array([[self._likeness(pairing, c, d) for d in theirs] for c in mine])
            if len(mine) != len(theirs):
                raise _Hopeless
            for r, c in zip(*linear_sum_assignment(table), strict=True) if mine else ():
                joints = pairing.joints_to(mine[r], theirs[c])
                costs = [pairing.joint_cost(i, j) for i, j in joints.items()]
                if table[r, c] >= 1e3 or max(costs, default=0.0) > self.tolerance:
                    raise _Hopeless
                images[mine[r]] = theirs[c]
        return mine

    def _likeness(self, pairing: Pairing, a: int, b: int) -> float:
        """How unlike two siblings are, wherever their own joints are."""
        one, other = (pairing.links[x] for x in (a, b))
        loose = [is_loose(self.model, x) for x in (a, b)]
        if (
            len(one.joints) != len(other.joints)
            or len(one.children) != len(other.children)
            or loose[0] != loose[1]
        ):
            return 1e3
        cost = sum(pairing.joint_cost(i, j) for i, j in pairing.joints_to(a, b).items())
        cost += abs(one.mass - other.mass) / pairing.total_mass
        moments = np.linalg.eigvalsh(one.inertia) - np.linalg.eigvalsh(other.inertia)
        cost += float(np.abs(moments).max()) / pairing.total_inertia + 1e-9 * (a != b)
        return cost + sum(self._off_path(pairing, a, b, j) for j in other.joints[:1])

    def _off_path(self, pairing: Pairing, a: int, b: int, joint: int) -> float:
        """How far link a's centre of mass stays from that of b, however its first joint moves it."""
        parts, axis = pairing.parts, pairing.parts.axes[joint]
        ends = pairing.matrix @ parts.centers[a], parts.centers[b]
        if int(self.model.jnt_type[joint]) == SLIDE:
            gap = ends[0] - ends[1]
            return float(np.linalg.norm(gap - (gap @ axis) * axis)) / parts.size(b)
        if int(self.model.jnt_type[joint]) != HINGE:
            return 0.0
        arms = [end - parts.anchors[joint] for end in ends]
        along = [float(arm @ axis) for arm in arms]
        radii = [float(np.linalg.norm(arm - h * axis)) for arm, h in zip(arms, along, strict=True)]
        return float(np.hypot(along[0] - along[1], radii[0] - radii[1])) / parts.size(b)

    def _settle(self, a: int) -> None:
        """Move the joints of the images of a link to where they belong, or its own where it is one."""
        for own in (True, False):
            for g in range(1, self.group.order):
                b = self.images[g].get(a)
                if b is None or (a == b) is not own or b in self.settled:
                    continue
                parts = self._parts()
                joints = parts.links[a].joints, parts.links[b].joints
                if len(joints[0]) != 1 or int(self.model.jnt_type[joints[0][0]]) not in (HINGE, SLIDE):
                    continue
                pairing = Pairing(parts, self.group.matrices[g].numpy())
                sign = pairing.sign(joints[0][0], joints[1][0])
                if own and sign > 0:
                    continue  # its coordinate is kept: there is no angle to choose
                move = self._move(pairing, a, b)
                self.qpos[self.model.jnt_qposadr[joints[1][0]]] += move / 2 if own else move
                if not own:
                    self.settled.add(b)
        self.settled.add(a)

    def _move(self, pairing: Pairing, a: int, b: int) -> float:
        """By how much the joint of b is to be moved so that b is the image of a."""
        parts, model = pairing.parts, self.model
        i, j = parts.links[a].joints[0], parts.links[b].joints[0]
        hinge = int(model.jnt_type[j]) == HINGE
        features = (
            [(kind, pairing.matrix @ x) for kind, x in self._features(parts, a)],
            [*self._features(parts, b)],
        )
        moves = [0.0]
        if model.jnt_limited[i] and model.jnt_limited[j]:
            sign, middles = pairing.sign(i, j), model.jnt_range[[i, j]].mean(axis=1)
            start, end = self.qpos[model.jnt_qposadr[[i, j]]]
            moves.append(float(middles[1] - sign * middles[0] + sign * start - end))
        for kind, x in features[0]:
            for other, y in features[1]:
                if kind == other:
                    moves += self._between(parts, j, x, y, kind[0] == "axis", hinge)
        costs = [self._cost(pairing, a, b, features, move) for move in moves]
        return next(m for m, cost in zip(moves, costs, strict=True) if cost <= min(costs) + _SAME)

    def _features(self, parts: Parts, a: int) -> Iterator[tuple[tuple, Array]]:
        """Points of a link, and axes of the joints on it, with what they are."""
        model, link = self.model, parts.links[a]
        if link.mass > 0:
            yield ("mass",), parts.centers[a]
        for child in link.children:
            for joint in parts.links[child].joints:
                yield ("anchor", int(model.jnt_type[joint])), parts.anchors[joint]
                if int(model.jnt_type[joint]) in (HINGE, SLIDE):
                    yield ("axis", int(model.jnt_type[joint])), parts.axes[joint]
        point = parts.points[link.tree]
        for geom in np.flatnonzero(np.isin(model.geom_bodyid, link.bodies)):
            size = tuple(np.round(model.geom_size[geom], 3).tolist())
            yield ("geom", int(model.geom_type[geom]), size), parts.data.geom_xpos[geom] - point

    def _between(
        self, parts: Parts, joint: int, x: Array, y: Array, free: bool, hinge: bool
    ) -> list[float]:
        """Moves of a joint that carry y to x: of points, or of free vectors up to their sign."""
        axis, anchor = parts.axes[joint], np.zeros(3) if free else parts.anchors[joint]
        if not hinge:
            return [] if free else [float(axis @ (x - y))]
        one, other = (v - anchor - ((v - anchor) @ axis) * axis for v in (x, y))
        least = _OFF_AXIS * (1.0 if free else parts.size(int(self.model.jnt_bodyid[joint])))
        lengths = [float(np.linalg.norm(v)) for v in (one, other)]
        if min(lengths) < least or abs(lengths[0] - lengths[1]) > 0.1 * max(lengths):
            return []
        angle = float(np.arctan2(np.cross(other, one) @ axis, other @ one))
        return [angle, angle - np.copysign(np.pi, angle)] if free else [angle]

    def _cost(self, pairing: Pairing, a: int, b: int, features: tuple, move: float) -> float:
        """How far b, moved, is from the image of a."""
        parts, joint = pairing.parts, pairing.links[b].joints[0]
        axis, anchor, size = parts.axes[joint], parts.anchors[joint], parts.size(b)
        hinge = int(self.model.jnt_type[joint]) == HINGE
        turn = _about(axis, move) if hinge else np.eye(3)

        def moved(kind: tuple, y: Array) -> Array:
            if kind[0] == "axis":
                return turn @ y
            return anchor + turn @ (y - anchor) if hinge else y + move * axis

        inertia = pairing.matrix @ pairing.links[a].inertia @ pairing.matrix.T
        gap = inertia - turn @ pairing.links[b].inertia @ turn.T
        scale = max(float(np.trace(inertia)), 1e-12)
        cost = float(np.abs(gap).max()) / scale + 1e-6 * abs(move)
        images = [(kind, moved(kind, y)) for kind, y in features[1]]
        for kind, x in features[0]:
            if kind[0] == "axis":
                cost += min((1 - abs(float(x @ y)) for k, y in images if k == kind), default=1.0)
            elif kind[0] != "anchor":  # a hinge's anchor may be anywhere on its axis
                cost += min(
                    (float(np.linalg.norm(x - y)) / size for k, y in images if k == kind), default=1.0
                )
        return cost


def _about(axis: Array, angle: float) -> Array:
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
