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
from torchrl_sym.representations import Representation


class FeedForward(nn.Module):
    """ELU network on its concatenated inputs, which are cast to its own precision.

    Args:
        in_size: number of inputs.
        out_size: number of outputs.
        hidden: sizes of the hidden layers.
        scale: factor on the outputs.
    """

    def __init__(self, in_size: int, out_size: int, hidden: Sequence[int], scale: float = 1.0) -> None:
        super().__init__()
        self.scale = scale
        self.net = MLP(in_size, out_size, num_cells=list(hidden), activation_class=nn.ELU)

    @property
    def linear(self) -> list[nn.Linear]:
        """The layers with weights, first to last."""
        return [layer for layer in self.net if isinstance(layer, nn.Linear)]

    def forward(self, *inputs: Tensor) -> Tensor:
        x = inputs[0] if len(inputs) == 1 else torch.cat(inputs, dim=-1)
        out = self.net(x.to(next(self.net.parameters()).dtype))
        return out if self.scale == 1.0 else out * self.scale


class Gaussian(nn.Module):
    """Mean from a network and a learned, bounded standard deviation that does not depend on the state.

    Args:
        mean: the network.
        std: initial standard deviation, and its lower and upper bound.
        size: number of actions.
        tied_by: the action's representation, to give equal deviations to actions that symmetric elements
            exchange (a mean of log_std over the orbit).
    """

    def __init__(
        self,
        mean: nn.Module,
        std: tuple[float, float, float],
        size: int,
        tied_by: Representation | None = None,
    ) -> None:
        super().__init__()
        initial, low, high = std
        if not low <= initial <= high:
            raise ValueError(f"expected an initial std in [{low}, {high}], got {initial}")
        self.mean = mean
        self.log_std = nn.Parameter(torch.full((size,), math.log(initial)))
        self.bounds = (math.log(low), math.log(high))
        self.tie = None if tied_by is None else tied_by.absolute()

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        loc = self.mean(*inputs)
        log_std = self.log_std if self.tie is None else self.tie.orbit(self.log_std).mean(0)
        return loc, log_std.clamp(*self.bounds).exp().expand_as(loc)


def make_actor(
    config: PPOConfig,
    in_keys: Sequence[NestedKey],
    in_size: int,
    out_size: int,
    action: Representation | None = None,
) -> ProbabilisticTensorDictSequential:
    """Gaussian policy on the concatenated inputs; actions are clipped by the environment, if at all.

    Args:
        config: hidden sizes, standard deviation and scale of the initial weights.
        in_keys: what it reads.
        in_size: number of entries it reads.
        out_size: number of actions.
        action: representation of the action, needed for ``config.tie_std``.
    """
    net = FeedForward(in_size, out_size, config.hidden, config.output_scale)
    with torch.no_grad():
        for layer in net.linear:
            scale = config.weight_scale * (config.last_layer_scale if layer is net.linear[-1] else 1.0)
            layer.weight.mul_(scale)
            layer.bias.mul_(scale)
    std = (config.initial_std, config.min_std, config.max_std)
    policy = Gaussian(net, std, out_size, action if config.tie_std else None)
    return ProbabilisticActor(
        TensorDictModule(policy, in_keys=list(in_keys), out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )


def make_critic(config: PPOConfig, in_keys: Sequence[NestedKey], in_size: int) -> ValueOperator:
    """State value on the concatenated inputs."""
    return ValueOperator(FeedForward(in_size, 1, config.hidden), in_keys=list(in_keys))
