"""TD3 with symmetric replay: every sampled row of gymnasium's Ant comes together with its mirror image.

The Ant is rewarded for speed along x, so its mirror image in the plane y = 0 earns what it earns itself.
The symmetry is read off the model; the buffer samples half as many rows and adds the copy of each, so
that a gradient is exactly that of data and mirrored data; the loss is TorchRL's own and knows of nothing.
For SAC, and one random element per row, see sac.py; for curves with and without, docs/off_policy.md.

    python examples/td3.py          # 15000 steps, about two minutes on an idle core
"""

import sys

import gymnasium as gym
import numpy as np
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage
from torchrl.envs import Compose, DoubleToFloat, GymWrapper, RewardSum, TransformedEnv
from torchrl.modules import MLP, AdditiveGaussianModule, ValueOperator
from torchrl.objectives import SoftUpdate, TD3Loss

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

net = MLP(27, 8, num_cells=[128, 128], activation_class=nn.ReLU)
actor = TensorDictModule(nn.Sequential(net, nn.Tanh()), ["observation"], ["action"])
noise = AdditiveGaussianModule(env.action_spec, annealing_num_steps=1, sigma_init=0.3, sigma_end=0.3)
critic = MLP(27 + 8, 1, num_cells=[128, 128], activation_class=nn.ReLU)
qvalue = ValueOperator(critic, in_keys=["observation", "action"])

loss = TD3Loss(actor, qvalue, loss_function="l2", action_spec=env.action_spec, delay_actor=True)
loss.make_value_estimator(gamma=0.95)
target = SoftUpdate(loss, tau=0.02)
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
buffer = SymmetryReplayBuffer(symmetry, storage=LazyTensorStorage(steps), batch_size=64)
collector = Collector(
    env,
    TensorDictSequential(actor, noise),
    frames_per_batch=EPISODE,
    total_frames=steps,
    init_random_frames=min(RANDOM, steps // 2),
)
collected, returns = 0, []
for data in collector:
    buffer.extend(data)
    collected += len(data)
    returns.append(data["next", "episode_reward"][-1].item())
    if collected < min(RANDOM, steps // 2):
        continue

    for update in range(EPISODE // 2):
        batch = buffer.sample()  # 64 rows and 64 mirrored ones
        total = loss.value_loss(batch)[0]
        if update % 2:  # the actor is updated half as often; what it feeds its tanh must not grow
            total = total + loss.actor_loss(batch)[0] + 0.1 * net(batch["observation"]).square().mean()
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        target.step()

    if collected % 1000 and collected < steps:
        continue
    with torch.no_grad():
        seen = data["observation"]
        action, mirrored = (net(x).tanh() for x in (seen, symmetry["observation"](seen, 1)))
    asymmetry = (mirrored - symmetry["action"](action, 1)).square().mean()
    earned = f"return of the last episodes {np.mean(returns[-8:]):.1f}"
    print(f"{collected} steps: {earned}, mirror error {asymmetry:.3f}")
collector.shutdown()
