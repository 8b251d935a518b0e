"""Train with rsl_rl: its PPO, its runner, and a symmetry from a file as its data augmentation function.

rsl_rl asks for a vectorised environment and for a function that makes the symmetric copies. Here the
environment is a task of this project, in twenty lines; Isaac Lab and mjlab bring theirs (`mjlab_ppo.py`).
What is declared once is kept in a file, and loaded wherever a policy is trained or tried.

    pip install rsl-rl-lib
    python examples/rsl_rl_ppo.py --iterations 150
"""

import argparse
import pathlib
import tempfile

import torch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

import tasks
from torchrl_sym import Symmetry
from torchrl_sym.bridges.rsl_rl import data_augmentation

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--iterations", type=int, default=150)
parser.add_argument("--num-envs", type=int, default=64)
args = parser.parse_args()


class TorchRLVecEnv(VecEnv):
    """A TorchRL environment, batched as `[num_envs]`, as rsl_rl wants it: an observation for each group."""

    def __init__(self, env):
        self.env, self.device, self.cfg = env, env.device or torch.device("cpu"), {}
        self.num_envs, self.num_actions = env.batch_size[0], env.action_spec.shape[-1]
        self.max_episode_length = 1000
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long)
        self.state = env.reset()

    def get_observations(self) -> TensorDict:
        return self.state.select(*self.env.observation_spec.keys()).float()

    def step(self, actions: torch.Tensor):
        self.state["action"] = self.env.action_spec.project(actions.to(self.env.action_spec.dtype))
        step, self.state = self.env.step_and_maybe_reset(self.state)
        after = step["next"]
        time_outs = (after["truncated"] & ~after["terminated"]).flatten()
        reward, done = after["reward"].flatten().float(), after["done"].flatten().long()
        self.episode_length_buf = (self.episode_length_buf + 1) * (1 - done)
        return self.get_observations(), reward, done, {"time_outs": time_outs}


torch.manual_seed(0)
env = TorchRLVecEnv(tasks.make_env("cartpole", num_envs=args.num_envs, seed=0))

file = pathlib.Path(tempfile.mkdtemp()) / "cartpole.json"
env.env.symmetry.save(file)  # written once, where the task is
symmetry = Symmetry.load(file)  # read where somebody trains
print(file.read_text())

network = {"class_name": "MLPModel", "hidden_dims": [32, 32], "activation": "elu"}
config = {
    "algorithm": {
        "class_name": "PPO",
        "entropy_coef": 0.0,
        "symmetry_cfg": {
            "data_augmentation_func": data_augmentation(symmetry),
            "use_data_augmentation": True,
        },
    },
    "actor": network
    | {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "scalar"}},
    "critic": network,
    "obs_groups": {"actor": ["observation"], "critic": ["observation"]},
    "num_steps_per_env": 16,
    "save_interval": 1000,
}
runner = OnPolicyRunner(env, config)
runner.learn(args.iterations)

policy, observed = runner.get_inference_policy(), env.get_observations()
with torch.no_grad():
    actions, images = policy(observed), policy(symmetry(observed, "reflect-x"))
    error = (symmetry["action"](actions, "reflect-x") - images).abs().mean() / actions.abs().mean()
print(f"after {args.iterations} iterations: mirror error {error:.3f} of the mean action")
