"""Train ANYmal in Isaac Lab by TorchRL's wrapper, with copies of all four of its symmetries.

Isaac Lab's observations are terms, each of which is declared once by its name; the joints go where a model
of the robot in MuJoCo's format says, by their names. Isaac Lab resets robots before anyone has seen where
their episodes ended, and TorchRL's wrapper says so with NaN: `LastSeen` puts there what was seen before, of
which rsl_rl, too, takes the value at time-outs.

    ./isaaclab.sh -p examples/isaac_lab.py --headless --num-envs 4096

Not run with Isaac Lab, which needs an NVIDIA GPU: written against the code of its 2.3.2 and of TorchRL's
wrapper, and run with a stand-in that answers as they do (tests/test_bridges_isaac_lab.py).
"""

import argparse
from pathlib import Path

from isaaclab.app import AppLauncher

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("task", nargs="?", default="Isaac-Velocity-Flat-Anymal-D-v0")
parser.add_argument("--iterations", type=int, default=300)
parser.add_argument("--num-envs", type=int, default=4096)
parser.add_argument("--folder", help="where checkpoints and metrics.csv go")
AppLauncher.add_app_launcher_args(parser)  # among them --device and --headless
args = parser.parse_args()
app = AppLauncher(args).app

# ruff: noqa: E402, since the simulator has to run before anything of it is imported
import gymnasium
import isaaclab_tasks  # noqa: F401, which registers the tasks
import mujoco
import torch
from isaaclab_tasks.utils import parse_env_cfg
from tensordict.utils import expand_as_right
from torchrl.envs import Transform
from torchrl.envs.libs.isaac_lab import IsaacLabWrapper

import tasks
from torchrl_sym import PointGroup
from torchrl_sym.bridges import isaac_lab
from torchrl_sym.mujoco import derive
from torchrl_sym.recipes import PPOConfig, train
from torchrl_sym.representations import axial, planar, polar, pseudoscalar


class LastSeen(Transform):
    """Where an episode has ended, the next observation is the one before it."""

    def _step(self, tensordict, next_tensordict):
        ended = next_tensordict["done"]
        for key in self.in_keys:
            seen = next_tensordict[key]
            next_tensordict[key] = torch.where(expand_as_right(ended[..., 0], seen), tensordict[key], seen)
        return next_tensordict


settings = parse_env_cfg(args.task, device=args.device, num_envs=args.num_envs)
env = IsaacLabWrapper(gymnasium.make(args.task, cfg=settings), device=torch.device(args.device))
env = env.append_transform(LastSeen(list(env.observation_spec.keys(True, True))))

group = PointGroup.klein_four()
model = Path(tasks.__file__).parent / "assets" / "anymal_push.xml"  # whose joints have Isaac Lab's names
robot = derive(mujoco.MjModel.from_xml_path(str(model)), group)
joints = robot.joints(env.unwrapped.scene["robot"].joint_names, relative=True)
terms = {
    "base_lin_vel": polar(group),
    "base_ang_vel": axial(group),
    "projected_gravity": polar(group),
    "velocity_commands": planar(group) + pseudoscalar(group),
} | dict.fromkeys(["joint_pos", "joint_vel", "actions"], joints)
symmetry = isaac_lab.symmetry(env, terms, action=joints)
symmetry.check_specs(env)  # every observation is declared, sizes fit, boxes are symmetric
print(symmetry)

config = PPOConfig(  # as Isaac Lab trains this task with rsl_rl
    iterations=args.iterations,
    num_envs=args.num_envs,
    horizon=24,
    epochs=5,
    minibatches=4,
    gamma=0.99,
    desired_kl=0.01,
    entropy_coeff=0.005,
    hidden=(128, 128, 128),
    tie_std=True,  # all four knees explore alike
    device=args.device,
)
for metrics in train(config, lambda **_: env, symmetry, folder=args.folder):
    print(
        f"iteration {metrics['iteration']}: return {metrics['return']:.3f}, KL {metrics['kl']:.4f}, "
        f"mirror loss {metrics['mirror_loss']:.4f}, std {metrics['std']:.2f}"
    )
app.close()
