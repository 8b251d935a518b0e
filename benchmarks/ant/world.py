"""The Ant of the off-policy study: its environments, its symmetry, and how a policy is measured on it.

The task is Ant-v5 without contact forces, rewarded for speed along x. Its mirror image in the plane y = 0
earns what it earns itself, so every stored transition is worth two. Four changes let it be learned within
ten thousand updates; none touches the symmetry: half the power, so that saturated actions do not throw the
robot; no reward for standing and no end when it leaves the healthy heights, so that the return is the way
that it went, less its effort; and a tenth of the control cost.
"""

from __future__ import annotations

from collections.abc import Callable

import gymnasium as gym
import mujoco
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torch import Tensor

from torchrl_sym import PointGroup, Symmetry
from torchrl_sym.mujoco import derive
from torchrl_sym.representations import axial, polar, quaternion, scalar

STEPS = 250  # per episode, 12.5 s
POWER = 0.5  # actions of the policy, in [-1, 1], times this are those of Ant-v5
SCALE = np.where(np.arange(27) < 13, 1.0, 0.2)  # of observations: speeds are larger than positions
TASK = {
    "include_cfrc_ext_in_observation": False,
    "healthy_reward": 0.0,
    "terminate_when_unhealthy": False,
    "ctrl_cost_weight": 0.05,
    "max_episode_steps": STEPS,
}
JOINTS = [f"{joint}_{leg}" for leg in (1, 2, 3, 4) for joint in ("hip", "ankle")]
MIRROR_EVERY = 10  # steps between measurements of the mirror error, whose states follow on each other

Act = Callable[[Tensor], Tensor]  # observations (seeds, episodes, 27) to actions (seeds, episodes, 8)


def make_env() -> gym.Env:
    """One Ant."""
    env = gym.make("Ant-v5", **TASK)
    env = gym.wrappers.TransformAction(env, lambda action: POWER * action, env.action_space)
    return gym.wrappers.TransformObservation(env, lambda seen: SCALE * seen, env.observation_space)


def make_envs(number: int) -> SyncVectorEnv:
    """Ants that step in this process, one after the other: the cheapest way there is."""
    return SyncVectorEnv([make_env] * number, autoreset_mode=AutoresetMode.SAME_STEP)


def ant_symmetry(model: mujoco.MjModel) -> Symmetry:
    """How Ant's observation and action look in the mirror y = 0."""
    group = PointGroup.reflection("y")
    robot = derive(model, group)
    joints = robot.joints(JOINTS)
    pose = scalar(group) + quaternion(group, "conjugate") + joints  # height, orientation, angles
    speeds = polar(group) + axial(group) + joints
    return Symmetry(group, {"observation": pose + speeds, "action": robot.actuators})


def evaluate(
    act: Act, envs: SyncVectorEnv, symmetry: Symmetry, seeds: tuple[int, ...]
) -> dict[str, np.ndarray]:
    """How the policies of all seeds do, each on its share of the environments.

    Returns:
        Means over the episodes of a seed, ``(seeds,)`` each: ``return``; ``x`` and ``y``, where the robot
        is in the end, in metres; and ``mirror_error``, the mean square over action entries of
        pi(L_g s) - K_g pi(s) at the states on the way.
    """
    episodes = envs.num_envs // len(seeds)
    starts = [100 * seed + 50 + k for seed in seeds for k in range(episodes)]
    observation, _ = envs.reset(seed=starts)
    returns, errors = np.zeros(envs.num_envs), []
    for step in range(STEPS):
        seen = torch.as_tensor(observation, dtype=torch.float32).unflatten(0, (len(seeds), episodes))
        action = act(seen)
        if step % MIRROR_EVERY == 0:
            mirrored = act(symmetry["observation"](seen, 1))
            errors.append((mirrored - symmetry["action"](action, 1)).square().mean((-2, -1)))
        observation, reward, _, _, info = envs.step(action.flatten(0, 1).numpy())
        returns += reward
    last = info["final_info"]  # all episodes end at the same step

    def mean(values: np.ndarray) -> np.ndarray:
        return values.reshape(len(seeds), episodes).mean(-1)

    measured = {"return": mean(returns), "x": mean(last["x_position"]), "y": mean(last["y_position"])}
    return measured | {"mirror_error": torch.stack(errors).mean(0).numpy()}
