"""Kinematics at the pose that a group is expected to keep."""

from __future__ import annotations

from torchrl_sym import checks
from torchrl_sym.mujoco.model.types import MjData, MjModel, mj


def reference_pose(model: MjModel, keyframe: int | str | None) -> MjData:
    """Kinematics at the pose that the group is expected to keep: qpos0, or a keyframe.

    Raises:
        KeyError: no such keyframe; the message lists those there are.
    """
    data = mj.MjData(model)
    if keyframe is not None:
        mj.mj_resetDataKeyframe(model, data, _number_of(model, keyframe))
    mj.mj_kinematics(model, data)
    mj.mj_comPos(model, data)
    return data


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
