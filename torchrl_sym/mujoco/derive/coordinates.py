"""How one isometry acts on the coordinates of a model: qpos, qvel and mocap poses.

With R the isometry, d its determinant, X_b the world rotation of body b at the reference pose and s(b)
the image of link b, the part of the isometry that acts within the body frame is V_b = X_s(b)^T R X_b. Then

- a hinge or slide coordinate becomes q'_s(j) = sign_j q_j + offset_j, with the sign from its axis; slides
  of one body may mix instead, q'_k = sum_j w_jk q_j + offset_k;
- a free joint's position becomes R p + t, its rotation R X V_b^-1, its velocities R v (world) and d V_b w
  (body frame), where x -> R x + t is the isometry, t = (I - R) o for an axis through o. That is so if the
  image of the frame's origin is the origin of the image's frame; bodies for which it is not are astray: how
  their position moves would depend on their rotation;
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
from scipy.optimize import linear_sum_assignment

from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.model.links import is_loose
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.rotations import conjugate, product, rotation, sandwich
from torchrl_sym.mujoco.model.types import BALL, FREE, HINGE, SLIDE, Array, MjData, MjModel

_ROUNDING = 1e-12  # offsets below it are none


@dataclass
class CoordinateMap:
    """One element's action, as matrices on the full vectors plus constants.

    Attributes:
        joints: the image of every joint; of one that mixes, the one that it is compared with.
        signs: of the coordinates of hinges and slides that do not mix, by source.
        offsets: of the coordinates of hinges and slides, by source: what is added to that of its image.
        mixed: of slides that mix, the weights with which their coordinates enter those of others.
        order: of links whose joints act in another order on the other side, how much that matters (0 to 1).
        at_zero: of ball joints, what V_b would be with the joint at zero.
        bodies: the image of every link.
        frames: the matrices V_b.
        astray: of free and mocap bodies, how far the image of their frame's origin is from that of their
            image, if it is not there.
    """

    joints: dict[int, int]
    signs: dict[int, float]
    offsets: dict[int, float]
    bodies: dict[int, int]
    frames: dict[int, Array]
    qpos: Array
    qpos_offset: Array
    qvel: Array
    mocap_position: Array
    mocap_offset: Array
    mocap_rotation: Array
    astray: dict[int, float]
    mixed: dict[int, dict[int, float]]
    order: dict[int, float]
    at_zero: dict[int, Array]

    @property
    def scalars(self) -> list[int]:
        """Hinges and slides, in the model's order."""
        return sorted(self.offsets)

    def weights(self, joint: int) -> dict[int, float]:
        """The weights with which the coordinate of a hinge or slide enters those of its images."""
        return self.mixed.get(joint) or {self.joints[joint]: self.signs[joint]}


def map_coordinates(matcher: Matcher, slides: dict[int, Array]) -> CoordinateMap:
    """Assemble the action from the images of links and joints.

    Args:
        matcher: the images.
        slides: axes of the slides of each link that an element of the group mixes.
    """
    model, data, images, joints = matcher.model, matcher.data, matcher.images, matcher.joints()
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
        np.zeros(3 * model.nmocap),
        np.zeros((4 * model.nmocap, 4 * model.nmocap)),
        {},
        {},
        {a: pairs.order for a, pairs in matcher.joint_pairs().items() if pairs.order > _ROUNDING},
        {},
    )
    for a, b in images.items():
        gap = float(np.linalg.norm(turn @ data.xpos[a] - image.xpos[b]))
        if is_loose(model, a) and gap > 1e-9 * matcher.extent:
            out.astray[a] = gap

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
            out.signs[i] = out.qpos[qj, qi] = out.qvel[vj, vi] = sign
        elif kind == FREE:
            out.qpos[qj : qj + 3, qi : qi + 3] = turn
            out.qpos_offset[qj : qj + 3] = matcher.shift
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
            zero, zero_image = (
                rotation(_at_zero(data, model, b, x)) for b, x in ((body, i), (images[body], j))
            )
            out.at_zero[i] = zero_image.T @ turn @ zero
    for a, axes in slides.items():
        _mix(out, matcher, a, slides[images[a]].T @ turn @ axes)
    for i, j in joints.items():
        if int(model.jnt_type[i]) in (HINGE, SLIDE):
            qj = int(model.jnt_qposadr[j])
            offset = float(data.qpos[qj] - out.qpos[qj] @ data.qpos)
            out.offsets[i] = out.qpos_offset[qj] = offset * (abs(offset) > _ROUNDING)
    for a, b in images.items():
        if model.body_mocapid[a] >= 0:
            i, j = 3 * int(model.body_mocapid[a]), 3 * int(model.body_mocapid[b])
            out.mocap_position[j : j + 3, i : i + 3] = turn
            out.mocap_offset[j : j + 3] = matcher.shift
            i, j = 4 * i // 3, 4 * j // 3
            out.mocap_rotation[j : j + 4, i : i + 4] = sandwich(q_turn, conjugate(q_frame(a)))
    return out


def _mix(out: CoordinateMap, matcher: Matcher, a: int, weights: Array) -> None:
    """Enter the matrix from the slides of link a to those of its image."""
    model, whole = matcher.model, np.abs(weights) > _ROUNDING
    mine, theirs = (
        [j for j in matcher.links[link].joints if int(model.jnt_type[j]) == SLIDE]
        for link in (a, matcher.images[a])
    )
    weights = np.where(whole, weights, 0.0)
    best = dict(zip(*linear_sum_assignment(-np.abs(weights.T)), strict=True))
    for x, i in enumerate(mine):
        del out.signs[i]
        out.joints[i] = theirs[best[x]]
        out.mixed[i] = {j: float(weights[y, x]) for y, j in enumerate(theirs) if whole[y, x]}
    rows, columns = ([model.jnt_qposadr[joints], model.jnt_dofadr[joints]] for joints in (theirs, mine))
    for matrix, row, column in zip((out.qpos, out.qvel), rows, columns, strict=True):
        matrix[np.ix_(row, column)] = weights


def _frame_owner(model: MjModel, body: int) -> int:
    """The link that a body's parent belongs to."""
    return int(weld_ids(model)[model.body_parentid[body]])


def _at_zero(data: MjData, model: MjModel, body: int, joint: int) -> Array:
    """World rotation that a ball-jointed body would have with its own rotation removed."""
    address = int(model.jnt_qposadr[joint])
    own = data.qpos[address : address + 4]
    return product(data.xquat[body], conjugate(own / np.linalg.norm(own)))
