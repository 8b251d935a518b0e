"""How often do two parts of a model touch?

A filter on one side only, an exclude or other collision bits, matters as far as its parts meet: the links
of a finger seldom do, a foot and the floor always. Contacts at random poses, every joint within its range,
give the share of poses in which they do; no sample proves that they never do. Parts that float free of each
other may be anywhere.
"""

from __future__ import annotations

import functools
import itertools
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from torchrl_sym.mujoco.model.types import BALL, FREE, HINGE, SLIDE, Array, MjData, MjModel, mj

POSES = 50
_CHAIN = 3  # of so many constraints in a row, the last joint still follows the first


class Encounters:
    """Contacts at random poses of a model, found when they are first asked for.

    Args:
        model: the compiled model.
        data: a pose; what no range bounds stays as it is there.
        labels: which set each geom belongs to, ``(ngeom,)``.
        bodies: the body of each set.
    """

    def __init__(
        self, model: MjModel, data: MjData, labels: NDArray[np.integer], bodies: NDArray[np.integer]
    ) -> None:
        self.model, self.reference = model, data
        self.labels, self.bodies = labels, bodies

    def share(self, a: int, b: int) -> float:
        """Share of poses in which a geom of one set touches one of another."""
        one, other = int(self.bodies[a]), int(self.bodies[b])
        if self.model.body_rootid[one] != self.model.body_rootid[other] and (
            self._drifts(one) or self._drifts(other)
        ):
            return 1.0
        return self._counts[min(a, b), max(a, b)] / POSES

    @functools.cached_property
    def _counts(self) -> Counter[tuple[int, int]]:
        """In how many poses each pair of sets touches."""
        model, data = self.model, mj.MjData(self.model)
        data.mocap_pos[:], data.mocap_quat[:] = self.reference.mocap_pos, self.reference.mocap_quat
        counts: Counter[tuple[int, int]] = Counter()
        for qpos in self._couple(self._drawn()):
            data.qpos[:] = qpos
            mj.mj_kinematics(model, data)
            mj.mj_collision(model, data)
            touching = np.sort(self.labels[np.array(data.contact.geom).reshape(-1, 2)], axis=1)
            counts.update({(a, b) for a, b in touching.tolist()})
        return counts

    def _drawn(self) -> Array:
        """Random positions of all joints, as far as it is known where they may be, ``(POSES, nq)``."""
        model, rng = self.model, np.random.default_rng(0)
        kinds, limited, address = model.jnt_type, model.jnt_limited != 0, model.jnt_qposadr
        low, high = np.where(limited[:, None], model.jnt_range, (-np.pi, np.pi)).T
        bounded = np.flatnonzero((kinds == HINGE) | (kinds == BALL) | ((kinds == SLIDE) & limited))
        runs = [(ball, [*run]) for ball, run in itertools.groupby(bounded, lambda j: kinds[j] == BALL)]

        poses = np.tile(self.reference.qpos, (POSES, 1))
        for qpos in poses:
            for ball, joints in runs:
                if not ball:
                    qpos[address[joints]] = rng.uniform(low[joints], high[joints])
                    continue
                for j in joints:
                    axis, start = rng.standard_normal(3), int(address[j])
                    angle = rng.uniform(0.0, high[j])
                    mj.mju_axisAngle2Quat(qpos[start : start + 4], axis / np.linalg.norm(axis), angle)
        return poses

    def _couple(self, poses: Array) -> Array:
        """Let joints follow those that equality constraints bind them to."""
        model = self.model
        coupled = (model.eq_type == int(mj.mjtEq.mjEQ_JOINT)) & (model.eq_active0 != 0)
        for e in np.tile(np.flatnonzero(coupled), _CHAIN):
            i, j = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
            start, other = (int(model.jnt_qposadr[k]) for k in (i, j))
            off = poses[:, other] - model.qpos0[other] if j >= 0 else np.zeros(len(poses))
            poses[:, start] = model.qpos0[start] + np.polyval(model.eq_data[e, :5][::-1], off)
        return poses

    def _drifts(self, body: int) -> bool:
        """Whether a joint between the world and a body has no end, or the body is a mocap body."""
        model = self.model
        while body:
            joints = model.body_jntadr[body] + np.arange(model.body_jntnum[body])
            kinds = model.jnt_type[joints]
            endless = (kinds == SLIDE) & (model.jnt_limited[joints] == 0)
            if model.body_mocapid[body] >= 0 or (endless | (kinds == FREE)).any():
                return True
            body = int(model.body_parentid[body])
        return False
