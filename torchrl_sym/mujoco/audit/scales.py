"""What is much for a joint? The torque that it works with, and times and lengths that go with it.

Friction of 0.1 N m is much in a finger and nothing in a hip. So friction, damping and springs are compared
with the joint's torque: that to which its motors are limited, else that which holds what hangs on it up
against gravity. Damping is compared at a speed, a spring at a deflection.

Where nothing limits a joint the values themselves are the scale, and a torque never counts for more than
``MOST`` times their size: a motor that is said to give 1e9 N m does not make friction vanish.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchrl_sym.mujoco.derive.lengths import is_fixed, joint_length, tendon_length
from torchrl_sym.mujoco.model.types import FREE, HINGE, SLIDE, Array, MjData, MjModel, mj

SPEED = 10.0  # of a turning joint, rad/s; of a sliding one, tree sizes per second
MOST = 1e3  # how much larger a scale may be than the largest value
_TRANSMISSION = mj.mjtTrn
_ON_JOINT = (int(_TRANSMISSION.mjTRN_JOINT), int(_TRANSMISSION.mjTRN_JOINTINPARENT))


@dataclass
class Efforts:
    """Torque or force of every degree of freedom, which turn, the size of what moves, inertias at qpos0."""

    torque: Array
    turning: NDArray[np.bool_]
    size: float
    inertia: Array

    def scale(self, term: str, values: Array) -> Array:
        """What a residual of 1 is, for each dof; ``values`` are the model's, ``(nv,)``."""
        natural = self._natural(term)
        masks = self.turning, ~self.turning
        largest = np.where(self.turning, *(np.abs(values[mask]).max(initial=0.0) for mask in masks))
        largest = np.where(largest > 0, largest, 1.0)
        return np.where(natural > 0, np.minimum(natural, MOST * largest), largest)

    def tendon_scale(self, term: str, values: Array, lengths: Array) -> Array:
        """What a residual of 1 is, for each tendon: what is as much for a joint that it moves.

        Args:
            term: which loss.
            values: the model's, ``(ntendon,)``.
            lengths: coefficients of velocities, ``(ntendon, nv)``; zero for spatial tendons.
        """
        levers = np.abs(lengths) ** (1 if term == "frictionloss" else 2)
        natural = np.where(levers > 0, self._natural(term) / np.where(levers > 0, levers, 1.0), np.inf)
        least, largest = natural.min(axis=1, initial=np.inf), float(np.abs(values).max(initial=0.0)) or 1.0
        return np.where(np.isfinite(least) & (least > 0), np.minimum(least, MOST * largest), largest)

    def _natural(self, term: str) -> Array:
        lengths = np.where(self.turning, 1.0, self.size)
        return {
            "frictionloss": self.torque,
            "damping": self.torque / (SPEED * lengths),
            "stiffness": self.torque / lengths,
            "armature": self.inertia,
        }.get(term, np.zeros_like(self.torque))


def efforts_of(model: MjModel, data: MjData, size: float) -> Efforts:
    """Torques of all dofs at a pose; ``size`` is that of what moves."""
    kinds = model.jnt_type[model.dof_jntid]
    offset = np.arange(model.nv) - model.jnt_dofadr[model.dof_jntid]
    linear = (kinds == SLIDE) | ((kinds == FREE) & (offset < 3))
    limits = _motor_limits(model)
    torque = np.where(limits > 0, limits, _weights(model, data, linear))
    return Efforts(torque, ~linear, max(size, 1e-6), np.array(model.dof_M0))


def _motor_limits(model: MjModel) -> Array:
    """Largest torque of each joint's motors; 0 where nothing limits it."""
    limits = np.zeros(model.nv)
    for a in range(model.nu):
        target, kind = int(model.actuator_trnid[a, 0]), int(model.actuator_trntype[a])
        if kind in _ON_JOINT and int(model.jnt_type[target]) in (HINGE, SLIDE):
            length = joint_length(model, target)
        elif kind == int(_TRANSMISSION.mjTRN_TENDON) and is_fixed(model, target):
            length = tendon_length(model, target)
        else:
            continue
        gear = abs(float(model.actuator_gear[a, 0]))
        force = 0.0
        if model.actuator_forcelimited[a]:
            force = float(np.abs(model.actuator_forcerange[a]).max())
        elif model.actuator_ctrllimited[a]:
            force = float(np.abs(model.actuator_ctrlrange[a]).max() * abs(model.actuator_gainprm[a, 0]))
        limits += force * gear * np.abs(length[: model.nv])
    for j in range(model.njnt):
        if model.jnt_actfrclimited[j]:
            start, count = int(model.jnt_dofadr[j]), {FREE: 6}.get(int(model.jnt_type[j]), 1)
            bound = float(np.abs(model.jnt_actfrcrange[j]).max())
            here = limits[start : start + count]
            limits[start : start + count] = np.where(here > 0, np.minimum(here, bound), bound)
    return limits


def _weights(model: MjModel, data: MjData, linear: NDArray[np.bool_]) -> Array:
    """Force of gravity on what hangs on each dof, for a turning one at its longest lever."""
    weight = float(np.linalg.norm(model.opt.gravity)) * model.body_subtreemass[model.dof_bodyid]
    lever = np.linalg.norm(data.subtree_com[model.dof_bodyid] - data.xanchor[model.dof_jntid], axis=1)
    return weight * np.where(linear, 1.0, lever)
