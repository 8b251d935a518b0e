"""symmetric_ppo.py with data from Ray: every collector is a process of its own, here or on other machines.

Collectors know nothing of the symmetry, and the loss nothing of where its batch was made. On a cluster, run
`ray start` on every machine and set RAY_ADDRESS here; every machine has this project installed.
"""

import functools
import sys

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.collectors.distributed import RayCollector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives.value import GAE

import tasks
from torchrl_sym import SymmetricClipPPOLoss

iterations = int(sys.argv[1]) if len(sys.argv) > 1 else 20
collectors = int(sys.argv[2]) if len(sys.argv) > 2 else 2
torch.manual_seed(0)
make_env = functools.partial(tasks.make_env, "cartpole", num_envs=64, num_threads=1)

net = nn.Sequential(MLP(3, 1, num_cells=[32, 32]), AddStateIndependentNormalScale(1))
actor = ProbabilisticActor(
    TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=IndependentNormal,
    return_log_prob=True,
)
critic = ValueOperator(MLP(3, 1, num_cells=[32, 32]), in_keys=["observation"])

frames = 64 * 32 * collectors
gae = GAE(gamma=0.98, lmbda=0.95, value_network=critic)
loss = SymmetricClipPPOLoss(actor, critic, symmetry=make_env(seed=0).symmetry, normalize_advantage=True)
optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=1e-3)
buffer = ReplayBuffer(
    storage=LazyTensorStorage(frames), sampler=SamplerWithoutReplacement(), batch_size=512
)
collector = RayCollector(
    [functools.partial(make_env, seed=seed) for seed in range(collectors)],
    actor,
    frames_per_batch=frames,
    total_frames=frames * iterations,
    sync=True,
    remote_configs={"num_cpus": 1, "num_gpus": 0},
    ray_init_config={"include_dashboard": False, "log_to_driver": False},
)
collector.update_policy_weights_(actor)
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
    collector.update_policy_weights_(actor)  # the next batch is of this policy: PPO is on-policy
    kl, kl_mirrored = out["kl_approx_sym"].tolist()
    reward = data["next", "reward"].mean()
    print(f"iteration {i}: reward {reward:.4f}, KL of samples {kl:.4f}, of mirror images {kl_mirrored:.4f}")
collector.shutdown()
