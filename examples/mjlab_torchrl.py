"""Train one of mjlab's robots by TorchRL: its wrapper gives the keys that the bridge declares.

mjlab names its groups of observations, "actor" and "critic" in its own tasks, and so do TorchRL's wrapper
and the symmetry that is read off the model. The recipe is told which group is whose, and does the rest: a
loop of your own takes the same symmetry in `SymmetricClipPPOLoss`.

    pip install mjlab
    python examples/mjlab_torchrl.py Mjlab-Velocity-Flat-Unitree-G1 --num-envs 4096 --device cuda:0

Run on the CPU with 4 robots, in mjlab's environment of `make test-mjlab`; nobody has tried it on a GPU.
"""

import argparse

import torch
from torchrl.envs import MJLabEnv

from torchrl_sym import PointGroup
from torchrl_sym.bridges import mjlab
from torchrl_sym.recipes import PPOConfig, train

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("task", nargs="?", default="Mjlab-Velocity-Flat-Unitree-G1")
parser.add_argument("--iterations", type=int, default=300)
parser.add_argument("--num-envs", type=int, default=4096)
parser.add_argument("--device", default="cuda:0")
parser.add_argument("--folder", help="where checkpoints and metrics.csv go")
args = parser.parse_args()
torch.set_num_threads(1)

env = MJLabEnv(args.task, num_envs=args.num_envs, device=args.device)
symmetry = mjlab.symmetry(env, PointGroup.reflection("y"))
symmetry.check_specs(env)  # every observation is declared, sizes fit, boxes are symmetric
print(symmetry)

config = PPOConfig(
    iterations=args.iterations,
    num_envs=args.num_envs,
    horizon=24,
    epochs=5,
    minibatches=4,
    gamma=0.99,
    desired_kl=0.01,
    entropy_coeff=0.01,  # these, and the sizes of the networks, as mjlab trains with rsl_rl
    hidden=(512, 256, 128),
    normalize_observations=True,  # by statistics that commute with the mirror, unlike rsl_rl's
    tie_std=True,  # left and right knee explore alike
    actor_keys=("actor",),
    critic_keys=("critic",),  # which knows more than the robot does
    device=args.device,
)
for metrics in train(config, lambda **_: env, symmetry, folder=args.folder):
    print(
        f"iteration {metrics['iteration']}: return {metrics['return']:.3f}, KL {metrics['kl']:.4f}, "
        f"mirror loss {metrics['mirror_loss']:.4f}, std {metrics['std']:.2f}"
    )
