"""SAC with symmetric replay: gymnasium's Ant learns to walk from its steps and from their mirror images.

The Ant is rewarded for speed along x, so its mirror image in the plane y = 0 earns what it earns itself.
The symmetry is read off the model; the buffer maps every sampled row by one random element of {e,
reflect-y}, state, action and next state together, at no cost in rows; the loss is TorchRL's own and knows
of nothing. For TD3, and every row together with its copy, see td3.py; for curves with and without,
docs/off_policy.md.

    python examples/sac.py          # 15000 steps, about two minutes on an idle core
"""

import sys

import gymnasium as gym
import numpy as np
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage
from torchrl.envs import Compose, DoubleToFloat, GymWrapper, RewardSum, TransformedEnv
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_sym import PointGroup, Symmetry, SymmetryReplayBuffer
from torchrl_sym.mujoco import derive
from torchrl_sym.representations import axial, polar, quaternion, scalar

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 15_000
EPISODE, RANDOM = 250, 2000  # steps; the first ones are random
torch.manual_seed(0)
torch.set_num_threads(1)

# half the power, rewards for the way alone, and speeds scaled to the size of positions: it learns faster
ant = gym.make(
    "Ant-v5",
    include_cfrc_ext_in_observation=False,
    healthy_reward=0.0,
    terminate_when_unhealthy=False,
    ctrl_cost_weight=0.05,
    max_episode_steps=EPISODE,
)
scale = np.where(np.arange(27) < 13, 1.0, 0.2)
scaled = gym.wrappers.TransformObservation(ant, lambda seen: scale * seen, ant.observation_space)
weak = gym.wrappers.TransformAction(scaled, lambda action: 0.5 * action, ant.action_space)
env = TransformedEnv(GymWrapper(weak), Compose(DoubleToFloat(["observation"]), RewardSum()))
env.set_seed(0)

group = PointGroup.reflection("y")
robot = derive(ant.unwrapped.model, group)
joints = robot.joints([f"{joint}_{leg}" for leg in (1, 2, 3, 4) for joint in ("hip", "ankle")])
pose = scalar(group) + quaternion(group, "conjugate") + joints  # height, orientation, angles
speeds = polar(group) + axial(group) + joints
symmetry = Symmetry(group, {"observation": pose + speeds, "action": robot.actuators})

net = MLP(27, 2 * 8, num_cells=[128, 128], activation_class=nn.ReLU)
actor = ProbabilisticActor(
    TensorDictModule(nn.Sequential(net, NormalParamExtractor()), ["observation"], ["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=TanhNormal,
    spec=env.action_spec,
)
critic = MLP(27 + 8, 1, num_cells=[128, 128], activation_class=nn.ReLU)
qvalue = ValueOperator(critic, in_keys=["observation", "action"])

loss = SACLoss(actor, qvalue, loss_function="l2", alpha_init=0.05, fixed_alpha=True)
loss.make_value_estimator(gamma=0.95)
target = SoftUpdate(loss, tau=0.02)
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
buffer = SymmetryReplayBuffer(symmetry, elements="random", storage=LazyTensorStorage(steps), batch_size=128)
collector = Collector(
    env, actor, frames_per_batch=EPISODE, total_frames=steps, init_random_frames=min(RANDOM, steps // 2)
)
collected, returns = 0, []
for data in collector:
    buffer.extend(data)
    collected += len(data)
    returns.append(data["next", "episode_reward"][-1].item())
    if collected < min(RANDOM, steps // 2):
        continue

    for _ in range(EPISODE // 2):
        batch = buffer.sample()  # 128 rows, about half of them mirrored
        out = loss(batch)
        optimizer.zero_grad()
        (out["loss_qvalue"] + out["loss_actor"]).backward()
        optimizer.step()
        target.step()

    if collected % 1000 and collected < steps:
        continue
    with torch.no_grad():
        seen = data["observation"]
        action, mirrored = (net(x).chunk(2, -1)[0].tanh() for x in (seen, symmetry["observation"](seen, 1)))
    asymmetry = (mirrored - symmetry["action"](action, 1)).square().mean()
    earned = f"return of the last episodes {np.mean(returns[-8:]):.1f}"
    print(f"{collected} steps: {earned}, mirror error {asymmetry:.3f}")
collector.shutdown()
