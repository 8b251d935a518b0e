"""The recipe's networks: a Gaussian actor with one learned standard deviation per action, and a critic."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import NestedKey
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator

from torchrl_sym.recipes.config import PPOConfig


class StateIndependentStd(nn.Module):
    """Appends a learned, bounded standard deviation to a mean: ``loc`` to ``(loc, scale)``."""

    def __init__(self, size: int, initial: float, low: float, high: float) -> None:
        super().__init__()
        if not low <= initial <= high:
            raise ValueError(f"expected an initial std in [{low}, {high}], got {initial}")
        self.log_std = nn.Parameter(torch.full((size,), math.log(initial)))
        self.bounds = (math.log(low), math.log(high))

    def forward(self, loc: Tensor) -> tuple[Tensor, Tensor]:
        return loc, self.log_std.clamp(*self.bounds).exp().expand_as(loc)


def make_actor(
    config: PPOConfig, in_keys: Sequence[NestedKey], in_size: int, out_size: int
) -> ProbabilisticTensorDictSequential:
    """Gaussian policy on the concatenated inputs; actions are clipped by the environment, if at all."""
    net = MLP(in_size, out_size, num_cells=list(config.hidden), activation_class=nn.ELU)
    linear = [layer for layer in net if isinstance(layer, nn.Linear)]
    with torch.no_grad():
        for layer in linear:
            layer.weight.mul_(config.weight_scale)
            layer.bias.mul_(config.weight_scale)
        linear[-1].weight.mul_(config.last_layer_scale)
        linear[-1].bias.mul_(config.last_layer_scale)
    std = StateIndependentStd(out_size, config.initial_std, config.min_std, config.max_std)
    return ProbabilisticActor(
        TensorDictModule(nn.Sequential(net, std), in_keys=list(in_keys), out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )


def make_critic(config: PPOConfig, in_keys: Sequence[NestedKey], in_size: int) -> ValueOperator:
    """State value on the concatenated inputs."""
    net = MLP(in_size, 1, num_cells=list(config.hidden), activation_class=nn.ELU)
    return ValueOperator(net, in_keys=list(in_keys))
