"""How often do two parts of a model touch?

A filter on one side only, an exclude or other collision bits, matters as far as its parts meet: the links
of a finger seldom do, a foot and the floor always. Contacts at random poses, every joint within its range,
give the share of poses in which they do; no sample proves that they never do. Parts that float free of each
other may be anywhere.
"""

from __future__ import annotations

import functools
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from torchrl_sym.mujoco.model.types import BALL, FREE, HINGE, SLIDE, MjData, MjModel, mj

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
        model, data, rng = self.model, mj.MjData(self.model), np.random.default_rng(0)
        data.mocap_pos[:], data.mocap_quat[:] = self.reference.mocap_pos, self.reference.mocap_quat
        counts: Counter[tuple[int, int]] = Counter()
        for _ in range(POSES):
            data.qpos[:] = self.reference.qpos
            for j in range(model.njnt):
                self._turn(data, j, rng)
            self._couple(data)
            mj.mj_kinematics(model, data)
            mj.mj_collision(model, data)
            touching = np.sort(self.labels[np.array(data.contact.geom).reshape(-1, 2)], axis=1)
            counts.update({(int(a), int(b)) for a, b in touching})
        return counts

    def _turn(self, data: MjData, joint: int, rng: np.random.Generator) -> None:
        """Give one joint a random position, as far as it is known where it may be."""
        model, kind = self.model, int(self.model.jnt_type[joint])
        start, limited = int(model.jnt_qposadr[joint]), bool(model.jnt_limited[joint])
        if kind in (HINGE, SLIDE) and limited:
            data.qpos[start] = rng.uniform(*model.jnt_range[joint])
        elif kind == HINGE:
            data.qpos[start] = rng.uniform(-np.pi, np.pi)
        elif kind == BALL:
            axis = rng.standard_normal(3)
            angle = rng.uniform(0.0, model.jnt_range[joint, 1] if limited else np.pi)
            mj.mju_axisAngle2Quat(data.qpos[start : start + 4], axis / np.linalg.norm(axis), angle)

    def _couple(self, data: MjData) -> None:
        """Let joints follow those that equality constraints bind them to."""
        model = self.model
        coupled = (model.eq_type == int(mj.mjtEq.mjEQ_JOINT)) & (model.eq_active0 != 0)
        for e in np.tile(np.flatnonzero(coupled), _CHAIN):
            i, j = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
            start, other = (int(model.jnt_qposadr[k]) for k in (i, j))
            off = data.qpos[other] - model.qpos0[other] if j >= 0 else 0.0
            data.qpos[start] = model.qpos0[start] + np.polyval(model.eq_data[e, :5][::-1], off)

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
