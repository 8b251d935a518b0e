"""Mirror losses beside any other loss: here of the actor and the Q functions of soft actor-critic.

The actor of `SACLoss` is the one that it is given, so that `MirrorLoss(actor)` would do as well. Its Q
functions are not: the loss draws the parameters of several anew, and `MirrorLoss.of` reaches those. The
coefficient is the paper's w: the loss sums over group elements, action entries and Q functions.
"""

import sys

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

import tasks
from torchrl_sym import MirrorLoss

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 100
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
updater = SoftUpdate(objective, tau=0.005)
mirror = MirrorLoss.of(objective, "actor_network", symmetry=env.symmetry, coeff=1.0)
mirror_q = MirrorLoss.of(objective, "qvalue_network", symmetry=env.symmetry, coeff=1.0)

with torch.no_grad():
    batch = env.rollout(64, actor).reshape(-1)
parameters = [p for p in objective.parameters() if p.requires_grad]  # the mirror losses have none
optimizer = torch.optim.Adam(parameters, lr=3e-3)
for step in range(steps + 1):
    losses = objective(batch)
    of_actor, of_q = mirror(batch)["loss_mirror"], mirror_q(batch)["loss_mirror"]
    total = losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"] + of_actor + of_q
    optimizer.zero_grad()
    total.backward()
    optimizer.step()
    updater.step()
    if step % 20 == 0:
        print(f"step {step:3d}: mirror {of_actor:.6f}, of Q {of_q:.6f}, actor {losses['loss_actor']:.3f}")
