"""How one element of a group moves rigid links and joints onto each other, at the pose that was found.

All places are relative to the axis that the group acts about, and trees that nothing holds stand on it, so
that an element sends a point x to R x, whatever part it belongs to.
"""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.derive.chains import JointPairs
from torchrl_sym.mujoco.derive.pairing import Misfit, Pairing
from torchrl_sym.mujoco.derive.parts import Parts
from torchrl_sym.mujoco.model.links import is_loose
from torchrl_sym.mujoco.model.poses import shift
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.types import Array, MjData, mj


class Matcher:
    """Image of every link and joint under one isometry.

    Args:
        parts: the model at the pose that the group keeps, its loose trees on the axis.
        matrix: the isometry R, ``(3, 3)``.
        lift: quaternion of R, or of -R for a reflection.
        axis: a point (world) of the axis; R acts on the world as x -> R x + (I - R) axis.
        loose: images of the trees that nothing holds.

    Attributes:
        data: kinematics at the reference pose, places relative to the axis.
        extent: size of the largest tree of moving links, which lengths are made relative to.
        image: kinematics where images are looked for: the reference pose, carried bodies turned by R.
        skeleton, links: how the model's links hang together.
        carried: bodies that are only carried along, so that their frames turn with the world.
        shift: (I - R) axis, what R adds to a point of the world.
        images: image of every link, as a map of body numbers.
    """

    def __init__(
        self, parts: Parts, matrix: Array, lift: Array, axis: Array, loose: dict[int, int]
    ) -> None:
        self.model, self.data, self.carried = parts.model, parts.data, parts.carried
        self.skeleton, self.links = parts.skeleton, parts.links
        self.matrix, self.lift, self.axis = matrix, lift, axis
        self.det = round(float(np.linalg.det(matrix)))
        self.shift = axis - matrix @ axis
        self.extent = parts.extent
        self.image = self._carry() if self.carried else self.data
        self.pairing = Pairing(parts, matrix)
        self.is_identity = np.array_equal(matrix, np.eye(3))
        if self.is_identity:
            self.images = {b: b for b in self.links}
        else:
            self.images = self.pairing.images(0, 0, loose | {b: b for b in self.carried})

    def _carry(self) -> MjData:
        model, data, image = self.model, self.data, mj.MjData(self.model)
        image.qpos[:], image.mocap_pos[:], image.mocap_quat[:] = data.qpos, data.mocap_pos, data.mocap_quat
        for body in self.carried:
            turned, place = np.zeros(4), self.matrix @ data.xpos[body] + self.axis
            mj.mju_mulQuat(turned, self.lift, data.xquat[body])
            mocap = int(model.body_mocapid[body])
            if mocap >= 0:
                image.mocap_pos[mocap], image.mocap_quat[mocap] = place, turned
            else:
                start = int(model.jnt_qposadr[model.body_jntadr[body]])
                image.qpos[start : start + 3] = place
                image.qpos[start + 3 : start + 7] = turned
        mj.mj_kinematics(model, image)
        mj.mj_comPos(model, image)
        shift(image, -self.axis)
        return image

    def size(self, body: int) -> float:
        """Size of the tree of moving links that a body is in: an object's own beside a robot."""
        return self.pairing.parts.size(int(weld_ids(self.model)[body]))

    def misfit(self, tolerance: float) -> Misfit:
        """The worst pair of links or joints; above 1 this is no symmetry."""
        if self.is_identity:
            return Misfit(0.0)
        missing = [b for b in self.links[0].children if b not in self.images]
        if missing:
            return Misfit(np.inf, "missing", missing[0])
        return self.pairing.worst(self.images, tolerance)

    def ambiguous(self) -> list[tuple[int, int]]:
        """Pairs of links that nothing tells apart."""
        if self.is_identity:  # of which nothing else asks how alike links are
            self.pairing.images(0, 0, {b: b for b in self.links[0].children if is_loose(self.model, b)})
        return self.pairing.ambiguous(self.images)

    def joints(self) -> dict[int, int]:
        """Image of every joint, if every link has one."""
        return {i: j for joints in self.joint_pairs().values() for i, j in joints.images.items()}

    def joint_pairs(self) -> dict[int, JointPairs]:
        """Images of the joints of every link."""
        return {a: self.pairing.joint_pairs(a, b) for a, b in self.images.items()}
