"""How a symmetry moves rigid links onto each other.

Matching at a single pose is enough: a kinematic tree is determined by its reference configuration and its
joint axes (the product of exponentials), so if masses, anchors and axes are mapped onto each other at one
pose that the symmetry keeps, the equations of motion are mapped onto each other everywhere.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchrl_sym.mujoco.model.links import Link, sizes_of
from torchrl_sym.mujoco.model.types import BALL, FREE, SLIDE, Array, MjData, MjModel, mj

_MISFIT = 1e3  # cost of a pair that cannot be the image of each other; far above any distance


class Matcher:
    """Finds the image of every link and joint under one isometry.

    Args:
        model: the compiled model.
        data: kinematics at the reference pose.
        links: from :func:`links_of`.
        matrix: the isometry R, ``(3, 3)``; it acts about the origin of the world.
        lift: quaternion of R, or of -R for a reflection.
        carried: bodies that are only carried along, so that their frames turn with the world.

    Attributes:
        extent: size of the largest tree of moving links, which lengths are made relative to.
        image: kinematics where images are looked for: the reference pose, carried bodies turned by R.
    """

    def __init__(
        self,
        model: MjModel,
        data: MjData,
        links: dict[int, Link],
        matrix: Array,
        lift: Array,
        carried: frozenset[int] = frozenset(),
    ) -> None:
        self.model, self.data, self.links = model, data, links
        self.matrix, self.lift, self.carried = matrix, lift, carried
        self.image = self._carry() if carried else data
        self.det = round(float(np.linalg.det(matrix)))
        sizes = sizes_of(model, data, links).values()
        self.extent = max(sizes, default=max(float(model.stat.extent), 1e-6))
        self.total_mass = max(sum(link.mass for link in links.values()), 1e-12)
        self.total_inertia = max(max(np.trace(link.inertia) for link in links.values()), 1e-12)
        self._pairs: dict[tuple[int, int], tuple[float, list[tuple[int, int]]]] = {}

    def _carry(self) -> MjData:
        model, data, image = self.model, self.data, mj.MjData(self.model)
        image.qpos[:], image.mocap_pos[:], image.mocap_quat[:] = data.qpos, data.mocap_pos, data.mocap_quat
        for body in self.carried:
            turned = np.zeros(4)
            mj.mju_mulQuat(turned, self.lift, data.xquat[body])
            mocap = int(model.body_mocapid[body])
            if mocap >= 0:
                image.mocap_pos[mocap], image.mocap_quat[mocap] = self.matrix @ data.xpos[body], turned
            else:
                start = int(model.jnt_qposadr[model.body_jntadr[body]])
                image.qpos[start : start + 3] = self.matrix @ data.xpos[body]
                image.qpos[start + 3 : start + 7] = turned
        mj.mj_kinematics(model, image)
        mj.mj_comPos(model, image)
        return image

    def links_to(self) -> dict[int, int]:
        """Image of every link, as a map of body numbers."""
        images: dict[int, int] = {}
        stack = [(0, 0)]
        while stack:
            a, b = stack.pop()
            images[a] = b
            stack += self._pair(a, b)[1]
        return images

    def joints_to(self, a: int, b: int) -> dict[int, int]:
        """Image among the joints of link b of every joint of link a; empty if their numbers differ."""
        mine, theirs = self.links[a].joints, self.links[b].joints
        if len(mine) != len(theirs) or not mine:
            return {}
        cost = np.array([[self.joint_cost(i, j) for j in theirs] for i in mine])
        rows, columns = linear_sum_assignment(cost)
        return {mine[r]: theirs[c] for r, c in zip(rows, columns, strict=True)}

    def joint_cost(self, i: int, j: int) -> float:
        """How far joint i's image is from joint j: type, axis up to sign, and anchor."""
        model, data = self.model, self.data
        kind = int(model.jnt_type[i])
        if kind != int(model.jnt_type[j]):
            return _MISFIT
        if kind == FREE:
            return 0.0
        offset = self.matrix @ data.xanchor[i] - data.xanchor[j]
        if kind == BALL:
            return float(np.linalg.norm(offset)) / self.extent
        axis = data.xaxis[j]
        misaligned = 1 - abs(float(self.matrix @ data.xaxis[i] @ axis))
        if kind == SLIDE:
            return misaligned  # a slide's anchor does not matter
        offset -= (offset @ axis) * axis  # a hinge's anchor may be anywhere on its axis
        return misaligned + float(np.linalg.norm(offset)) / self.extent

    def _pair(self, a: int, b: int) -> tuple[float, list[tuple[int, int]]]:
        if (a, b) not in self._pairs:  # not functools.cache, which does not pickle
            self._pairs[a, b] = self._pair_of_links(a, b)
        return self._pairs[a, b]

    def _pair_of_links(self, a: int, b: int) -> tuple[float, list[tuple[int, int]]]:
        """Cost of mapping subtree a onto subtree b, and the best pairs of children."""
        one, other = self.links[a], self.links[b]
        cost = float(np.linalg.norm(self.matrix @ one.com - other.com)) / self.extent
        cost += abs(one.mass - other.mass) / self.total_mass
        image = self.matrix @ one.inertia @ self.matrix.T
        cost += float(np.abs(image - other.inertia).max()) / self.total_inertia
        cost += 1e-9 * (a != b)  # links at one place stay where they are
        is_mocap = self.model.body_mocapid[[a, b]] >= 0
        cost += _MISFIT * bool(is_mocap[0] != is_mocap[1])
        joints = self.joints_to(a, b)
        if len(joints) != len(one.joints) or len(one.joints) != len(other.joints):
            cost += _MISFIT
        cost += sum(self.joint_cost(i, j) for i, j in joints.items())
        own = [(c, c) for c in one.children if c in self.carried and a == b]
        mine, theirs = ([c for c in link.children if c not in self.carried] for link in (one, other))
        if not mine or not theirs:
            return cost + _MISFIT * (len(mine) != len(theirs)), own
        table = np.array([[self._pair(c, d)[0] for d in theirs] for c in mine])
        rows, columns = linear_sum_assignment(table)
        cost += float(table[rows, columns].sum())
        cost += _MISFIT * abs(len(mine) - len(theirs))
        return cost, own + [(mine[r], theirs[c]) for r, c in zip(rows, columns, strict=True)]
