"""Small symmetric tasks for the tests of the losses: groups, actors, critics, batches, gradients.

Observations are a polar vector and a pseudoscalar, actions a planar vector and a pseudoscalar, so that
C2 and K4 act by signs and C3 and D3 by dense blocks. Networks are random, hence strongly asymmetric.
"""

from collections.abc import Iterable

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import LossModule

from torchrl_sym import PointGroup, Symmetry
from torchrl_sym.representations import planar, polar, pseudoscalar

OBSERVATION_DIM, ACTION_DIM = 4, 3

GROUPS = {
    "C1": PointGroup.trivial(),
    "C2": PointGroup.reflection("y"),
    "K4": PointGroup.klein_four(),
    "C3": PointGroup.rotation(3),
    "D3": PointGroup.dihedral(3),
}
SYMMETRIC = ["C2", "K4", "C3", "D3"]


class CatInputs(nn.Module):
    """A network of an observation and an action side by side, as Q functions are."""

    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, observation, action):
        return self.net(torch.cat([observation, action], -1))


def make_symmetry(
    group: str = "C2", observation: NestedKey = "observation", action: NestedKey = "action"
) -> Symmetry:
    g = GROUPS[group]
    return Symmetry(g, {observation: polar(g) + pseudoscalar(g), action: planar(g) + pseudoscalar(g)})


def make_actor(
    distribution: type = IndependentNormal,
    observation: NestedKey = "observation",
    action: NestedKey = "action",
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
    asymmetry: float = 3.0,
    **kwargs,
) -> ProbabilisticActor:
    torch.manual_seed(seed)
    net = nn.Sequential(
        nn.Linear(OBSERVATION_DIM, 8),
        nn.Tanh(),
        nn.Linear(8, 2 * ACTION_DIM),
        NormalParamExtractor(),
    )
    net[2].weight.data.mul_(asymmetry)
    box = {"low": -2.0, "high": 2.0} if distribution is TanhNormal else {}
    return ProbabilisticActor(
        TensorDictModule(net.to(dtype), [observation], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[action],
        distribution_class=distribution,
        distribution_kwargs=box,
        return_log_prob=True,
        **kwargs,
    )


def make_critic(
    observation: NestedKey = "observation",
    value: NestedKey = "state_value",
    dtype: torch.dtype = torch.float64,
) -> ValueOperator:
    torch.manual_seed(1)
    net = nn.Sequential(nn.Linear(OBSERVATION_DIM, 8), nn.Tanh(), nn.Linear(8, 1))
    return ValueOperator(net.to(dtype), in_keys=[observation], out_keys=[value])


def make_batch(
    *size: int, dtype: torch.dtype = torch.float64, bound: float | None = None, seed: int = 2
) -> TensorDict:
    """A batch as a collector and GAE leave it; actions within ``bound`` if given."""
    size = size or (12,)
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*size, *shape, generator=generator, dtype=torch.float64).to(dtype)

    action = normal(ACTION_DIM)
    return TensorDict(
        observation=normal(OBSERVATION_DIM),
        action=action if bound is None else bound * action.tanh(),
        action_log_prob=-3.0 + normal(),
        advantage=normal(1),
        value_target=normal(1),
        state_value=normal(1),
        batch_size=size,
    )


def near_policy(batch: TensorDict, actor: ProbabilisticActor, spread: float = 0.3) -> TensorDict:
    """The batch with old log-probabilities near the actor's: some ratios inside, some outside."""
    with torch.no_grad():
        log_prob = actor.get_dist(batch.copy()).log_prob(batch["action"])
    noise = torch.randn(log_prob.shape, generator=torch.Generator().manual_seed(3))
    return batch.copy().set("action_log_prob", log_prob + spread * noise.to(log_prob))


def add_transitions(batch: TensorDict) -> TensorDict:
    """A trajectory batch [B, T] before advantage estimation: rewards and next observations."""
    out = batch.exclude("advantage", "value_target", "state_value")
    generator = torch.Generator().manual_seed(4)
    reward = torch.randn(*batch.shape, 1, generator=generator, dtype=torch.float64)
    following = out["observation"].roll(-1, dims=-2).clone()
    done = torch.zeros(*batch.shape, 1, dtype=torch.bool)
    done[..., -1, :] = True
    return out.set(
        "next",
        TensorDict(
            observation=following,
            reward=reward.to(following.dtype),
            done=done,
            terminated=torch.zeros_like(done),
            batch_size=batch.shape,
        ),
    )


def total(out: TensorDictBase, only: Iterable[str] | None = None) -> Tensor:
    """Sum of the losses in a loss module's output, or of the named ones."""
    names = [name for name, _ in out.items() if name.startswith("loss_")] if only is None else only
    return torch.stack([out[name].sum() for name in names]).sum()


def gradients(
    loss: LossModule,
    batch: TensorDictBase,
    modules: Iterable[nn.Module],
    only: Iterable[str] | None = None,
) -> Tensor:
    """Gradient of the summed losses in all parameters of the modules, as one vector."""
    parameters = [p for module in modules for p in module.parameters()]
    found = torch.autograd.grad(total(loss(batch), only), parameters, allow_unused=True)
    return torch.cat(
        [
            torch.zeros_like(p).flatten() if g is None else g.flatten()
            for p, g in zip(parameters, found, strict=True)
        ]
    )


def assert_unchanged(loss: LossModule, batch: TensorDictBase) -> None:
    """A loss must leave its input's keys and values alone."""
    before = batch.clone()
    loss(batch)
    assert set(batch.keys(True)) == set(before.keys(True))
    assert batch.batch_size == before.batch_size
    for key, value in before.items(True, True):
        assert torch.equal(batch[key], value), key


def unbiased(draws: Tensor, expected: Tensor) -> tuple[bool, Tensor]:
    """Whether the mean of many random gradients ``(K, P)`` is the expected one, and its z-scores.

    With P correlated normal scores, the largest passes 5 with a probability below P * 6e-7.
    """
    error = draws.std(0) / len(draws) ** 0.5
    z = (draws.mean(0) - expected) / error.clamp_min(1e-12)
    return bool(z.abs().max() < 5), z
