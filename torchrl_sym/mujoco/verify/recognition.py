"""Which kind of environment is it? An environment is recognised by what it offers, not by its class."""

from __future__ import annotations

from typing import Any

from torchrl.envs import EnvBase

from torchrl_sym._torchrl import wrapped_env
from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.verify.batched import BatchedSubject
from torchrl_sym.mujoco.verify.control import ComposerSubject, ControlSubject
from torchrl_sym.mujoco.verify.gymnasium_env import GymnasiumSubject
from torchrl_sym.mujoco.verify.remembered import Remembered
from torchrl_sym.mujoco.verify.subjects import Pose, Subject


def subject_of(
    env: Any, group: PointGroup, observe: Any, pose: Pose, seed: int, memory: Remembered | None = None
) -> Subject:
    """The environment behind the interface, by what it offers.

    Raises:
        TypeError: an environment of another kind.
        ValueError: a pose or memory for one that maps its whole state itself.
    """
    if isinstance(env, EnvBase):
        env = wrapped_env(env)
    if not hasattr(env, "base_env"):
        if hasattr(env, "reset_to") and hasattr(getattr(env, "task", None), "transform_state"):
            if pose != Pose() or memory is not None:
                names = memory and list(memory.representations)
                raise ValueError(
                    "expected neither keyframe, carried nor memory for a batched task environment, which "
                    f"maps its state itself, got {pose.keyframe!r}, {pose.carried!r} and {names}; leave "
                    "them out, and keep what it remembers in its state"
                )
            return BatchedSubject(env, observe, seed)
        if all(hasattr(env, name) for name in ("physics", "task", "action_spec")):
            kind = ControlSubject if hasattr(env.task, "get_observation") else ComposerSubject
            return kind(env, group, observe, pose, seed, memory)
        base = getattr(env, "unwrapped", None)
        if all(hasattr(base, name) for name in ("model", "data", "_get_obs")):
            return GymnasiumSubject(env, group, observe, pose, seed, memory)
    raise TypeError(
        "expected a batched task environment (reset_to, task.transform_state), a dm_control Environment "
        f"(physics, task) or a gymnasium MujocoEnv (model, data, _get_obs), got {type(env).__name__}; pass "
        "the innermost environment and apply transforms with observe=..."
    )
