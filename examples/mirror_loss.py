"""The mirror loss beside any other loss: here soft actor-critic on a batch of CartPole transitions.

`MirrorLoss` only needs the actor and the symmetry, so it adds to every objective that TorchRL has. Its
coefficient is the paper's w: the loss sums over group elements and action entries.
"""

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss

import tasks
from torchrl_sym import MirrorLoss

torch.manual_seed(0)
env = tasks.make_env("cartpole", num_envs=64, num_threads=1, seed=0)

net = nn.Sequential(MLP(3, 2, num_cells=[64, 64]), NormalParamExtractor())
actor = ProbabilisticActor(
    TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=TanhNormal,
    spec=env.action_spec_unbatched,
)
critic = ValueOperator(MLP(4, 1, num_cells=[64, 64]), in_keys=["observation", "action"])

objective = SACLoss(actor, critic, action_spec=env.action_spec_unbatched)
objective.make_value_estimator(gamma=0.98)
mirror = MirrorLoss(actor, symmetry=env.symmetry, coeff=1.0)

with torch.no_grad():
    batch = env.rollout(64, actor).reshape(-1)
parameters = [p for p in objective.parameters() if p.requires_grad]  # the mirror loss shares the actor's
optimizer = torch.optim.Adam(parameters, lr=3e-3)
for step in range(101):
    losses = objective(batch).update(mirror(batch))
    total = sum(value for key, value in losses.items() if key.startswith("loss_"))
    optimizer.zero_grad()
    total.backward()
    optimizer.step()
    if step % 20 == 0:
        print(f"step {step:3d}: actor {losses['loss_actor']:.3f}, mirror {losses['loss_mirror']:.6f}")
