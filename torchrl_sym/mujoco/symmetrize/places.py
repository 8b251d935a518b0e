"""Averages of where bodies and joints are.

An anchor moves across its hinge's axis only, as its place along it is free.
"""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.model.links import is_loose
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.rotations import rotation
from torchrl_sym.mujoco.model.types import BALL, HINGE, SLIDE, mj, name_of
from torchrl_sym.mujoco.symmetrize.averager import Averager, frame_of


def place_joints(averager: Averager) -> None:
    """Average anchors and axes, and move the frames of bodies along with them."""
    model, data = averager.model, averager.data
    maps = [action.coordinates.joints for action in averager.actions]
    owner = [int(b) for b in model.jnt_bodyid]
    anchors = averager.points(maps, data.xanchor, lambda j: owner[j])
    axes = {}
    for b in range(model.njnt):
        turned = [averager.turns[g] @ data.xaxis[a] for g, m in enumerate(maps) for a in m if m[a] == b]
        total = sum(axis * np.sign(axis @ data.xaxis[b]) for axis in turned)
        axes[b] = total / np.linalg.norm(total)
        if int(model.jnt_type[b]) == HINGE:
            along = axes[b] @ (anchors[b] - data.xanchor[b])
            anchors[b] = anchors[b] - along * axes[b]
    for body, link in averager.links.items():
        turning = [j for j in link.joints if int(model.jnt_type[j]) in (HINGE, BALL)]
        if turning:
            averager.moved[body] = anchors[turning[0]] - data.xanchor[turning[0]]
    for body, link in averager.links.items():
        if body and not is_loose(model, body):
            _write_body(averager, body, link.joints, anchors, axes)


def _write_body(averager: Averager, body: int, joints: list[int], anchors: dict, axes: dict) -> None:
    """Undo the joints one by one, from the new world pose to the pose in the parent's frame."""
    model, data = averager.model, averager.data
    turn, place = averager.rotation[body], data.xpos[body] + averager.moved[body]
    name = name_of(model, "body", body)
    for j in reversed(joints):
        kind, joint = int(model.jnt_type[j]), averager.spec.joints[j]
        label = name_of(model, "joint", j)
        axis, at = turn.T @ axes[j], turn.T @ (anchors[j] - place)
        angle = float(data.qpos[model.jnt_qposadr[j]] - model.qpos0[model.jnt_qposadr[j]])
        if kind != SLIDE:
            at = averager.local(joint, at, model.jnt_pos[j], "joint anchor", label)
        if kind != BALL:
            inner = frame_of(joint)[1].T
            averager.write(joint, "axis", inner @ axis, inner @ model.jnt_axis[j], "joint axis", label, 1.0)
        if kind == SLIDE:
            place = place - angle * axes[j]
            continue
        q = np.zeros(4)
        mj.mju_axisAngle2Quat(q, axis, angle)
        if kind == BALL:
            start = int(model.jnt_qposadr[j])
            q = data.qpos[start : start + 4] / np.linalg.norm(data.qpos[start : start + 4])
        turn = turn @ rotation(q).T
        place = anchors[j] - turn @ at
    parent = int(model.body_parentid[body])
    base = data.xpos[parent] + averager.moved[int(weld_ids(model)[parent])]
    outer = averager.rotation[parent]
    averager.pose(averager.spec.bodies[body], outer.T @ (place - base), outer.T @ turn, "body", name)
