"""How one isometry acts on the coordinates of a model: qpos, qvel and mocap poses.

With R the isometry, d its determinant, X_b the world rotation of body b at the reference pose and s(b)
the image of link b, the part of the isometry that acts within the body frame is V_b = X_s(b)^T R X_b. Then

- a hinge or slide coordinate becomes q'_s(j) = sign_j q_j + offset_j, with the sign from its axis;
- a free joint's position becomes R p, its rotation R X V_b^-1, its velocities R v (world) and d V_b w
  (body frame);
- a body that is only carried along by a turn of the world keeps its own frame, V_b = I: its image is looked
  for at R X_b, and its rotation becomes R X, its angular velocity stays;
- a ball joint's rotation, relative to its parent p, becomes B_s(b)^T V_p B_b X V_b^-1 with B_b the fixed
  rotation of b in p.

Rotations are kept proper by d R and d V. Quaternions are mapped by matrices L(q_R) R(q_V^-1); taking q_V =
x_s(b)^-1 q_R x_b makes the unknown sign of q_R cancel, so that the matrices compose. Where only L(q_R) is
left, that of a carried body, the sign is the one with q_R^n = 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.model.links import Link
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.rotations import conjugate, product, sandwich
from torchrl_sym.mujoco.model.types import BALL, FREE, HINGE, SLIDE, Array, MjData, MjModel


@dataclass
class CoordinateMap:
    """One element's action, as matrices on the full vectors plus constants."""

    joints: dict[int, int]
    signs: dict[int, float]
    offsets: dict[int, float]
    bodies: dict[int, int]
    frames: dict[int, Array]
    qpos: Array
    qpos_offset: Array
    qvel: Array
    mocap_position: Array
    mocap_rotation: Array


def map_coordinates(
    model: MjModel,
    data: MjData,
    links: dict[int, Link],
    matcher: Matcher,
    images: dict[int, int],
    joints: dict[int, int],
) -> CoordinateMap:
    """Assemble the action from the images of links and joints; ``frames`` are the matrices V_b."""
    turn, det = matcher.matrix, matcher.det
    q_turn, image = matcher.lift, matcher.image
    before, after = (each.xmat.reshape(-1, 3, 3) for each in (data, image))
    frames = {
        a: np.eye(3) if a in matcher.carried else after[b].T @ turn @ before[a] for a, b in images.items()
    }
    out = CoordinateMap(
        joints,
        {},
        {},
        images,
        frames,
        np.zeros((model.nq, model.nq)),
        np.zeros(model.nq),
        np.zeros((model.nv, model.nv)),
        np.zeros((3 * model.nmocap, 3 * model.nmocap)),
        np.zeros((4 * model.nmocap, 4 * model.nmocap)),
    )

    def q_frame(a: int) -> Array:  # x_s(b)^-1 q_R x_b, a lift of d V_b
        if a in matcher.carried:
            return np.eye(4)[0]
        return product(conjugate(image.xquat[images[a]]), product(q_turn, data.xquat[a]))

    for i, j in joints.items():
        kind, body = int(model.jnt_type[i]), int(model.jnt_bodyid[i])
        qi, qj = int(model.jnt_qposadr[i]), int(model.jnt_qposadr[j])
        vi, vj = int(model.jnt_dofadr[i]), int(model.jnt_dofadr[j])
        if kind in (HINGE, SLIDE):
            handed = det if kind == HINGE else 1
            sign = 1.0 if handed * float(turn @ data.xaxis[i] @ data.xaxis[j]) > 0 else -1.0
            offset = float(data.qpos[qj] - sign * data.qpos[qi])
            out.signs[i], out.offsets[i] = sign, offset
            out.qpos[qj, qi] = out.qvel[vj, vi] = sign
            out.qpos_offset[qj] = offset
        elif kind == FREE:
            out.qpos[qj : qj + 3, qi : qi + 3] = turn
            out.qpos[qj + 3 : qj + 7, qi + 3 : qi + 7] = sandwich(q_turn, conjugate(q_frame(body)))
            out.qvel[vj : vj + 3, vi : vi + 3] = turn
            out.qvel[vj + 3 : vj + 6, vi + 3 : vi + 6] = det * frames[body]
        elif kind == BALL:
            parent = _frame_owner(model, body)
            fixed = product(conjugate(data.xquat[parent]), _at_zero(data, model, body, i))
            fixed_image = product(
                conjugate(data.xquat[_frame_owner(model, images[body])]),
                _at_zero(data, model, images[body], j),
            )
            left = product(conjugate(fixed_image), product(q_frame(parent), fixed))
            out.qpos[qj : qj + 4, qi : qi + 4] = sandwich(left, conjugate(q_frame(body)))
            out.qvel[vj : vj + 3, vi : vi + 3] = det * frames[body]
    for a, b in images.items():
        if model.body_mocapid[a] >= 0:
            i, j = 3 * int(model.body_mocapid[a]), 3 * int(model.body_mocapid[b])
            out.mocap_position[j : j + 3, i : i + 3] = turn
            i, j = 4 * i // 3, 4 * j // 3
            out.mocap_rotation[j : j + 4, i : i + 4] = sandwich(q_turn, conjugate(q_frame(a)))
    return out


def _frame_owner(model: MjModel, body: int) -> int:
    """The link that a body's parent belongs to."""
    return int(weld_ids(model)[model.body_parentid[body]])


def _at_zero(data: MjData, model: MjModel, body: int, joint: int) -> Array:
    """World rotation that a ball-jointed body would have with its own rotation removed."""
    address = int(model.jnt_qposadr[joint])
    own = data.qpos[address : address + 4]
    return product(data.xquat[body], conjugate(own / np.linalg.norm(own)))
