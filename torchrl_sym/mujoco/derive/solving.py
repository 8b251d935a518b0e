"""A pose that a group keeps, where a model's file has none.

Encoders are zeroed where they happened to be: a leg's zero may be its hanging pose on the left and a raised
one on the right. Whether the legs are mirror images does not depend on that. From the root to the leaves,
once a link's parent is in place, its joint's anchor and axis are; what is left is one angle. It is read off
the link itself: from its centre of mass, its shapes, the joints on it, or the middles of the ranges, by
trying each and keeping the one at which most of the link is where its image should be.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.derive.gaps import Gaps
from torchrl_sym.mujoco.derive.moving import Fit
from torchrl_sym.mujoco.derive.pairing import Pairing
from torchrl_sym.mujoco.derive.parts import Parts
from torchrl_sym.mujoco.model.links import Skeleton, is_loose
from torchrl_sym.mujoco.model.poses import Pose, kinematics
from torchrl_sym.mujoco.model.types import HINGE, SLIDE, Array, mj


def solved(
    skeleton: Skeleton,
    group: PointGroup,
    pose: Pose,
    axis: Array,
    carried: frozenset[int],
    tolerance: float,
) -> Pose | None:
    """The pose with hinges and slides moved so that the group keeps it; None if that does not help."""
    return _Solver(skeleton, group, pose, axis, carried, tolerance).solve()


class _Hopeless(Exception):
    """A joint has no image, wherever the joints are that it does not hang on."""


class _Solver:
    def __init__(
        self,
        skeleton: Skeleton,
        group: PointGroup,
        pose: Pose,
        axis: Array,
        carried: frozenset[int],
        tolerance: float,
    ) -> None:
        self.skeleton, self.model, self.links = skeleton, skeleton.model, skeleton.links
        self.matrices, self.pose, self.axis, self.carried = group.matrices.numpy(), pose, axis, carried
        self.tolerance = tolerance
        self.qpos, self.data = pose.qpos.copy(), mj.MjData(self.model)
        self.parts = self._parts()
        self.moments = np.linalg.eigvalsh(self.parts.inertias)  # the same at every pose
        self.settled: set[int] = set()
        # of the identity, which is not solved for, nothing is asked
        self.images: list[dict[int, int]] = [{}, *({0: 0} for _ in range(1, group.order))]

    def solve(self) -> Pose | None:
        try:
            queue = [self._siblings(0)]
            while queue:
                for a in queue.pop(0):
                    self._settle(a)
                    queue.append(self._siblings(a))
        except _Hopeless:
            return None
        return self.pose.at(self.qpos, f"{self.pose.words}, with joints moved to where they are symmetric")

    def _parts(self) -> Parts:
        """Where everything is with the joints as they are now; what was returned before is overwritten."""
        data = kinematics(self.model, self.pose.at(self.qpos), self.data)
        parts = Parts.of(self.skeleton, data, self.carried)
        return parts.about(dict.fromkeys(parts.fixed, self.axis))

    def _children(self, a: int) -> list[int]:
        return [c for c in self.links[a].children if c not in self.carried]

    def _siblings(self, a: int) -> list[int]:
        """Children of a link; finds their images under every element."""
        mine = self._children(a)
        for images, matrix in zip(self.images, self.matrices, strict=True):
            if a not in images:
                continue
            theirs = self._children(images[a])
            if len(mine) != len(theirs):
                raise _Hopeless
            pairing = Pairing(self.parts, matrix)
            for c, d in self._assigned(pairing, mine, theirs):
                joints = pairing.joints_to(c, d)
                costs = [pairing.joint_cost(i, j) for i, j in joints.items()]
                if not self._alike(c, d) or max(costs, default=0.0) > self.tolerance:
                    raise _Hopeless
                images[c] = d
        return mine

    def _assigned(self, pairing: Pairing, mine: list[int], theirs: list[int]) -> list[tuple[int, int]]:
        """Pairs of siblings that are most alike."""
        if len(mine) <= 1:
            return [*zip(mine, theirs, strict=True)]
        pairs = [(c, d) for c in mine for d in theirs]
        pairing.measure_joints([pair for pair in pairs if self._alike(*pair)])
        table = np.array([self._likeness(pairing, *pair) for pair in pairs]).reshape(len(mine), -1)
        return [(mine[r], theirs[c]) for r, c in zip(*linear_sum_assignment(table), strict=True)]

    def _alike(self, a: int, b: int) -> bool:
        """Whether two links have as many joints and children, and are both held or both loose."""
        one, other = self.links[a], self.links[b]
        return (
            len(one.joints) == len(other.joints)
            and len(one.children) == len(other.children)
            and is_loose(self.model, a) == is_loose(self.model, b)
        )

    def _likeness(self, pairing: Pairing, a: int, b: int) -> float:
        """How unlike two siblings are, wherever their own joints are."""
        if not self._alike(a, b):
            return 1e3
        one, other = self.links[a], self.links[b]
        cost = sum(pairing.joint_cost(i, j) for i, j in pairing.joints_to(a, b).items())
        cost += abs(one.mass - other.mass) / self.skeleton.total_mass
        moments = float(np.abs(self.moments[a] - self.moments[b]).max())
        cost += moments / self.parts.total_inertia + 1e-9 * (a != b)
        return cost + sum(self._off_path(pairing, a, b, j) for j in other.joints[:1])

    def _off_path(self, pairing: Pairing, a: int, b: int, joint: int) -> float:
        """How far link a's centre of mass stays from that of b, however its first joint moves it."""
        parts, axis = pairing.parts, pairing.parts.axes[joint]
        ends = np.stack([pairing.gaps.centers[a], parts.centers[b]])
        if int(self.model.jnt_type[joint]) == SLIDE:
            gap = ends[0] - ends[1]
            return float(np.linalg.norm(gap - (gap @ axis) * axis)) / parts.size(b)
        if int(self.model.jnt_type[joint]) != HINGE:
            return 0.0
        arms = ends - parts.anchors[joint]
        along = arms @ axis
        radii = np.linalg.norm(arms - along[:, None] * axis, axis=1)
        return float(np.hypot(along[0] - along[1], radii[0] - radii[1])) / parts.size(b)

    def _settle(self, a: int) -> None:
        """Move the joints of the images of a link to where they belong, or its own where it is one."""
        for own in (True, False):
            for images, matrix in zip(self.images, self.matrices, strict=True):
                b = images.get(a)
                if b is None or (a == b) is not own or b in self.settled:
                    continue
                joints = self.links[a].joints, self.links[b].joints
                if len(joints[0]) != 1 or int(self.model.jnt_type[joints[0][0]]) not in (HINGE, SLIDE):
                    continue
                gaps = Gaps(self.parts, matrix)
                if own and gaps.signs([(joints[0][0], joints[1][0])])[0] > 0:
                    continue  # its coordinate is kept: there is no angle to choose
                move = Fit(gaps, a, b).move()
                if move != 0.0:
                    self.qpos[self.model.jnt_qposadr[joints[1][0]]] += move / 2 if own else move
                    self.parts = self._parts()
                if not own:
                    self.settled.add(b)
        self.settled.add(a)
