"""Train one of mjlab's robots with symmetric copies: the symmetry is read off its model and its terms.

Nothing is declared but the group. What has no image is named: the velocity sensor of mjlab's Go1, say, is
on one side of the robot; and a term of your own needs a line in `terms`.

    pip install mjlab
    python examples/mjlab_ppo.py Mjlab-Velocity-Flat-Unitree-G1 --num-envs 4096 --device cuda:0
"""

import argparse
import dataclasses

import torch
from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg

from torchrl_sym import PointGroup
from torchrl_sym.bridges import mjlab
from torchrl_sym.bridges.rsl_rl import data_augmentation

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("task", nargs="?", default="Mjlab-Velocity-Flat-Unitree-G1")
parser.add_argument("--iterations", type=int, default=300)
parser.add_argument("--num-envs", type=int, default=4096)
parser.add_argument("--device", default="cuda:0")
parser.add_argument("--out", help="a file to keep the symmetry in, for where the policy is used")
args = parser.parse_args()

env_config = load_env_cfg(args.task)
env_config.scene.num_envs = args.num_envs
env = RslRlVecEnvWrapper(ManagerBasedRlEnv(env_config, device=args.device))

symmetry = mjlab.symmetry(env, PointGroup.reflection("y"))
print(symmetry)
if args.out:
    symmetry.save(args.out)

config = dataclasses.asdict(load_rl_cfg(args.task))
config["algorithm"]["symmetry_cfg"] = {
    "data_augmentation_func": data_augmentation(symmetry),
    "use_data_augmentation": True,
}
runner = MjlabOnPolicyRunner(env, config, device=args.device)
runner.learn(args.iterations)

policy, observed = runner.get_inference_policy(args.device), env.get_observations()
with torch.no_grad():
    actions, images = policy(observed), policy(symmetry(observed, "reflect-y"))
    error = (symmetry["action"](actions, "reflect-y") - images).abs().mean() / actions.abs().mean()
print(f"after {args.iterations} iterations: mirror error {error:.3f} of the mean action")
env.close()
