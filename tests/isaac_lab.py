"""A stand-in for Isaac Lab, which needs an NVIDIA GPU: what its examples and TorchRL's wrapper ask of it.

Names, order of the steps and what is returned are those of Isaac Lab 2.3.2 (app_launcher.py, parse_cfg.py,
manager_based_rl_env.py, velocity_env_cfg.py). The dynamics are linear and commute with every symmetry of
ANYmal, so that robots in mirrored states stay images of each other.
"""

import importlib.machinery
import sys
from types import ModuleType, SimpleNamespace

import gymnasium
import torch
from torchrl.envs.libs import gym, isaac_lab

from tests.managers import Manager
from tests.managers import cfg as term
from torchrl_sym import PointGroup
from torchrl_sym.representations import invariant

TASK = "Isaac-Velocity-Flat-Anymal-D-v0"
JOINTS = [f"{leg}_{joint}" for joint in ("HAA", "HFE", "KFE") for leg in ("LF", "LH", "RF", "RH")]
SIZES = {
    "base_lin_vel": 3,
    "base_ang_vel": 3,
    "projected_gravity": 3,
    "velocity_commands": 3,
    "joint_pos": 12,
    "joint_vel": 12,
    "actions": 12,
}
LENGTH = 7  # steps of an episode


class ManagerBasedEnv:
    """The base class by which TorchRL's wrapper knows Isaac Lab's environments."""


class ManagerBasedRLEnv(ManagerBasedEnv, gymnasium.Env):
    """Robots that are reset in the step in which their episode ends, before they are observed.

    Attributes:
        frames: what every term reads of the robots' state, ``(num_envs, size)`` each.
    """

    def __init__(self, cfg):
        self.cfg, self.num_envs, self.device = cfg, cfg.scene.num_envs, cfg.sim.device
        self.scene = {"robot": SimpleNamespace(joint_names=list(JOINTS))}
        trivial = PointGroup.trivial()
        sizes = {name: invariant(trivial, size) for name, size in SIZES.items()}
        self.observation_manager = Manager({"policy": {name: term() for name in SIZES}}, sizes)
        self.frames = {name: torch.zeros(self.num_envs, size) for name, size in SIZES.items()}
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long)
        self.single_observation_space = gymnasium.spaces.Dict(policy=_box(sum(SIZES.values())))
        self.single_action_space = _box(12)
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, self.num_envs)
        self.action_space = batch(self.single_action_space, self.num_envs)

    def _observe(self):
        return self.observation_manager.compute({name: x[None] for name, x in self.frames.items()})

    def _reset_idx(self, env_ids):
        for name, values in self.frames.items():
            values[env_ids] = 0 if name == "actions" else torch.randn(len(env_ids), values.shape[1])
        self.episode_length_buf[env_ids] = torch.randint(LENGTH, (len(env_ids),))

    def reset(self, seed=None, env_ids=None, options=None):
        if seed is not None:
            torch.manual_seed(seed)
        self._reset_idx(torch.arange(self.num_envs) if env_ids is None else env_ids)
        return self._observe(), {}

    def step(self, action):
        frames = self.frames
        frames["joint_vel"] = 0.9 * frames["joint_vel"] + 0.1 * action
        frames["joint_pos"] = frames["joint_pos"] + 0.02 * frames["joint_vel"]
        frames["base_lin_vel"] = 0.9 * frames["base_lin_vel"] + 0.1 * frames["projected_gravity"]
        frames["actions"] = action.clone()
        self.episode_length_buf += 1
        fallen = frames["joint_vel"].norm(dim=-1) > 5
        late = (self.episode_length_buf >= LENGTH) & ~fallen
        reward = -frames["base_lin_vel"].norm(dim=-1)
        self._reset_idx((fallen | late).nonzero().squeeze(-1))
        return self._observe(), reward, fallen, late, {"log": {}}


def _box(size):
    return gymnasium.spaces.Box(-float("inf"), float("inf"), (size,))


class AppLauncher:
    """Starts nothing."""

    def __init__(self, launcher_args):
        self.app = SimpleNamespace(close=lambda: None)

    @staticmethod
    def add_app_launcher_args(parser):
        parser.add_argument("--headless", action="store_true")
        parser.add_argument("--device", default="cuda:0")


def parse_env_cfg(task_name, device="cuda:0", num_envs=None, use_fabric=None):
    assert task_name == TASK
    return SimpleNamespace(
        sim=SimpleNamespace(device=device), scene=SimpleNamespace(num_envs=num_envs or 4096)
    )


def install(set_item, set_attribute):
    """Put the stand-in where Isaac Lab would be imported from.

    Args:
        set_item: sets an item of a dictionary, as `monkeypatch.setitem` does.
        set_attribute: sets an attribute of a module, as `setattr` does.
    """

    class Direct:
        """Nothing here is one."""

    contents = {
        "isaaclab": {},
        "isaaclab.app": {"AppLauncher": AppLauncher},
        "isaaclab.envs": {
            "ManagerBasedEnv": ManagerBasedEnv,
            "DirectRLEnv": Direct,
            "DirectMARLEnv": Direct,
        },
        "isaaclab_tasks": {},
        "isaaclab_tasks.utils": {"parse_env_cfg": parse_env_cfg},
    }
    for name, attributes in contents.items():
        module = ModuleType(name)
        module.__spec__ = importlib.machinery.ModuleSpec(name, None)
        module.__dict__.update(attributes)
        set_item(sys.modules, name, module)
    for module in (gym, isaac_lab):
        set_attribute(module, "_has_isaaclab", True)
    if TASK not in gymnasium.registry:
        gymnasium.register(TASK, ManagerBasedRLEnv, disable_env_checker=True)
