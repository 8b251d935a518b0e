"""SymmetricClipPPOLoss in a hand-written TorchRL loop.

It is a ClipPPOLoss: replace the class, name the symmetry, and leave the rest of the loop as it is.
"""

import sys

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives.value import GAE

import tasks
from torchrl_sym import SymmetricClipPPOLoss

iterations = int(sys.argv[1]) if len(sys.argv) > 1 else 20
torch.manual_seed(0)
torch.set_num_threads(1)  # the physics has its own threads
env = tasks.make_env("cartpole", num_envs=64, num_threads=1, seed=0)

net = nn.Sequential(MLP(3, 1, num_cells=[32, 32]), AddStateIndependentNormalScale(1))
actor = ProbabilisticActor(
    TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=IndependentNormal,
    return_log_prob=True,
)
critic = ValueOperator(MLP(3, 1, num_cells=[32, 32]), in_keys=["observation"])

gae = GAE(gamma=0.98, lmbda=0.95, value_network=critic)
loss = SymmetricClipPPOLoss(actor, critic, symmetry=env.symmetry, normalize_advantage=True)
optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=1e-3)
buffer = ReplayBuffer(
    storage=LazyTensorStorage(64 * 32), sampler=SamplerWithoutReplacement(), batch_size=512
)
collector = Collector(env, actor, frames_per_batch=64 * 32, total_frames=64 * 32 * iterations)
for i, data in enumerate(collector):
    with torch.no_grad():
        gae(data)  # on the original samples
    buffer.extend(data.reshape(-1))
    for _ in range(4):
        for minibatch in buffer:
            out = loss(minibatch)  # on the originals and their mirror images
            optimizer.zero_grad()
            (out["loss_objective"] + out["loss_critic"] + out["loss_entropy"]).backward()
            optimizer.step()
    kl, kl_mirrored = out["kl_approx_sym"].tolist()
    reward = data["next", "reward"].mean()
    print(f"iteration {i}: reward {reward:.4f}, KL of samples {kl:.4f}, of mirror images {kl_mirrored:.4f}")
collector.shutdown()
