"""Axes, anchors, ranges, springs and losses of joints."""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.audit.comparison import Comparison, column_scale
from torchrl_sym.mujoco.model.types import BALL, FREE, HINGE, SLIDE


def compare_joints(c: Comparison) -> None:
    """Axes, anchors, ranges, stiffness and limits."""
    model, data, turn = c.model, c.data, c.matcher.matrix  # no carried body has an axis
    rest = c.map.qpos @ model.qpos_spring + c.map.qpos_offset
    for i, j in c.map.joints.items():
        name, kind = c.name("joint", i, j), int(model.jnt_type[i])
        sign, shift = c.map.signs.get(i, 1.0), c.map.offsets.get(i, 0.0)
        gap = turn @ data.xanchor[i] - data.xanchor[j]
        if kind in (HINGE, SLIDE):
            axis = data.xaxis[j]
            c.add("joint axis", float(np.linalg.norm(np.cross(turn @ data.xaxis[i], axis))), name)
            gap = np.cross(gap, axis) if kind == HINGE else np.zeros(3)
        if kind != FREE:
            c.add("joint anchor", float(np.linalg.norm(gap)) / c.matcher.extent, name)
        c.range("joint range", "jnt_range", "jnt_limited", i, j, sign, shift, name)
        c.range("joint force range", "jnt_actfrcrange", "jnt_actfrclimited", i, j, sign, 0.0, name)
        same = np.flatnonzero(model.jnt_type == kind)
        c.fields("stiffness", ["jnt_stiffness"], i, j, name, same)
        c.fields("joint gravity compensation", ["jnt_actgravcomp"], i, j, name, same)
        if model.jnt_limited[i] or model.jnt_limited[j]:
            c.fields("joint solref/solimp", ["jnt_solref", "jnt_solimp", "jnt_margin"], i, j, name)
        if model.jnt_stiffness[i] > 0:
            start, size = int(model.jnt_qposadr[j]), {FREE: 7, BALL: 4}.get(kind, 1)
            one, other = rest[start : start + size], model.qpos_spring[start : start + size]
            if kind in (FREE, BALL):  # a quaternion and its negative are one rotation
                one = np.concatenate([one[:-4], one[-4:] * np.sign(one[-4:] @ other[-4:] or 1.0)])
            scale = c.matcher.extent if kind == SLIDE else 1.0
            c.add("springref", float(np.abs(one - other).max()) / scale, name)


def compare_dofs(c: Comparison) -> None:
    """Damping, armature and friction loss: M diag(x) M^T = diag(x) with M the map of velocities."""
    model, turn = c.model, c.map.qvel
    joints = model.dof_jntid
    offset = np.arange(model.nv) - model.jnt_dofadr[joints]
    kinds = model.jnt_type[joints]
    linear = (kinds == SLIDE) | ((kinds == FREE) & (offset < 3))  # not in the units of turning dofs
    for term, field in (
        ("damping", "dof_damping"),
        ("armature", "dof_armature"),
        ("frictionloss", "dof_frictionloss"),
    ):
        values = getattr(model, field)
        if not values.any():
            continue
        scale = np.where(linear, *(column_scale(values[mask]) for mask in (linear, ~linear)))
        gap = np.abs(turn @ np.diag(values) @ turn.T - np.diag(values))
        gap = (gap / np.sqrt(np.outer(scale, scale))).max(axis=1, initial=0.0)
        for i, j in c.map.joints.items():
            start = int(model.jnt_dofadr[j])
            stop = start + {FREE: 6, BALL: 3}.get(int(model.jnt_type[j]), 1)
            c.add(term, float(gap[start:stop].max()), c.name("joint", i, j))
    for i, j in c.map.joints.items():
        a, b = int(model.jnt_dofadr[i]), int(model.jnt_dofadr[j])
        if model.dof_frictionloss[a] > 0:
            c.fields("joint solref/solimp", ["dof_solref", "dof_solimp"], a, b, c.name("joint", i, j))
