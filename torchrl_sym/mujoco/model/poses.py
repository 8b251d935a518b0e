"""Poses of a model that a group may keep, and kinematics at one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from torchrl_sym import checks
from torchrl_sym.mujoco.model.types import BALL, HINGE, SLIDE, Array, MjData, MjModel, mj


@dataclass(frozen=True)
class Pose:
    """Coordinates, mocap poses and what they are, in words."""

    words: str
    qpos: Array
    mocap_pos: Array
    mocap_quat: Array

    def at(self, qpos: Array, words: str | None = None) -> Pose:
        """The same with other coordinates."""
        return replace(self, qpos=qpos, words=words or self.words)


def poses(model: MjModel, keyframe: int | str | None = None) -> list[Pose]:
    """Poses that may be symmetric: the keyframe asked for, else qpos0, keyframes, zeros, middles of ranges.

    Raises:
        KeyError: no such keyframe; the message lists those there are.
    """
    if keyframe is not None:
        return [_keyframe(model, _number_of(model, keyframe))]
    start = _pose(mj.MjData(model), "qpos0")
    found = [start, *(_keyframe(model, k) for k in range(model.nkey))]
    on_line = (model.jnt_type == HINGE) | (model.jnt_type == SLIDE)
    address, limited = model.jnt_qposadr, on_line & (model.jnt_limited != 0)
    zeros, middles = start.qpos.copy(), start.qpos.copy()
    zeros[address[on_line]] = 0.0
    for ball in address[model.jnt_type == BALL]:
        zeros[ball : ball + 4] = np.eye(4)[0]
    middles[address[limited]] = model.jnt_range[limited].mean(axis=1)
    found += [
        start.at(zeros, "all joints at zero"),
        start.at(middles, "joints at the middle of their ranges"),
    ]
    kept: list[Pose] = []
    for pose in found:
        if not any(_alike(pose, other) for other in kept):
            kept.append(pose)
    return kept


def kinematics(model: MjModel, pose: Pose, data: MjData | None = None) -> MjData:
    """Where everything is at a pose.

    Args:
        model: the model.
        pose: the pose.
        data: to be overwritten; a new one by default, which takes longer to make than to fill.
    """
    filled: MjData = mj.MjData(model) if data is None else data
    filled.qpos[:], filled.mocap_pos[:], filled.mocap_quat[:] = pose.qpos, pose.mocap_pos, pose.mocap_quat
    mj.mj_kinematics(model, filled)
    mj.mj_comPos(model, filled)
    return filled


def reference_pose(model: MjModel, keyframe: int | str | None) -> MjData:
    """Where everything is in qpos0, or at a keyframe."""
    return kinematics(model, poses(model, keyframe)[0])


def shift(data: MjData, by: Array) -> None:
    """Move all places of kinematics."""
    for name in (
        "xpos",
        "xipos",
        "xanchor",
        "geom_xpos",
        "site_xpos",
        "cam_xpos",
        "light_xpos",
        "subtree_com",
    ):
        getattr(data, name)[:] += by


def _keyframe(model: MjModel, number: int) -> Pose:
    data = mj.MjData(model)
    mj.mj_resetDataKeyframe(model, data, number)
    return _pose(data, f"keyframe {model.key(number).name or number!r}")


def _pose(data: MjData, words: str) -> Pose:
    return Pose(words, data.qpos.copy(), data.mocap_pos.copy(), data.mocap_quat.copy())


def _alike(one: Pose, other: Pose) -> bool:
    values = zip(
        (one.qpos, one.mocap_pos, one.mocap_quat),
        (other.qpos, other.mocap_pos, other.mocap_quat),
        strict=True,
    )
    return all(np.allclose(a, b, atol=1e-9) for a, b in values)


def _number_of(model: MjModel, keyframe: int | str) -> int:
    names = [model.key(i).name or None for i in range(model.nkey)]
    try:
        return (
            names.index(keyframe)
            if isinstance(keyframe, str)
            else checks.whole("keyframe", keyframe, 0, model.nkey - 1)
        )
    except ValueError as error:
        raise KeyError(f"no keyframe {keyframe!r}; the model has {names or 'none'}") from error
