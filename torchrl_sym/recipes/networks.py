"""The recipe's networks: a Gaussian actor with one learned standard deviation per action, and a critic."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import IndependentNormal, ProbabilisticActor

from torchrl_sym.normalization import SymmetricNorm
from torchrl_sym.recipes.architectures import make_net, scale_weights
from torchrl_sym.recipes.config import PPOConfig
from torchrl_sym.recipes.keyed import KeyedModule
from torchrl_sym.representations import Representation, scalar
from torchrl_sym.symmetry import Symmetry


class FeedForward(nn.Module):
    """A network on its concatenated inputs, which are cast to its own precision.

    Args:
        net: what computes.
        scale: factor on the outputs.
        norm: normalises the inputs first.
        event_dims: number of event dimensions of each input. Defaults to one each.
    """

    def __init__(
        self,
        net: nn.Module,
        scale: float = 1.0,
        *,
        norm: SymmetricNorm | None = None,
        event_dims: Sequence[int] | None = None,
    ) -> None:
        super().__init__()
        self.scale, self.norm, self.event_dims = scale, norm, event_dims
        self.net = net

    def forward(self, *inputs: Tensor) -> Tensor:
        if self.norm is not None:
            normal = self.norm(*inputs)
            inputs = normal if isinstance(normal, tuple) else (normal,)
        if self.event_dims is not None:
            inputs = tuple(x.flatten(-d) for x, d in zip(inputs, self.event_dims, strict=True))
        x = inputs[0] if len(inputs) == 1 else torch.cat(inputs, dim=-1)
        out = self.net(x.to(next(self.net.parameters()).dtype))
        return out if self.scale == 1.0 else out * self.scale


class Gaussian(nn.Module):
    """Mean from a network, and a standard deviation that does not depend on the state.

    The deviation is learned between two bounds or follows a schedule. At a bound it is held by projection
    (:meth:`keep_in_bounds`), never by a clamp in the forward pass: the gradient of a clamp is zero beyond
    the bound, so that a parameter which is there, as after a stage with another bound, would stay there.

    Args:
        mean: the network.
        std: initial standard deviation.
        size: number of actions.
        bounds: lower and upper bound of the standard deviation.
        tied_by: the action's representation, to give equal deviations to actions that symmetric elements
            exchange or mix (a mean of log_std over them).
    """

    def __init__(
        self,
        mean: nn.Module,
        std: float,
        size: int,
        bounds: tuple[float, float],
        tied_by: Representation | None = None,
    ) -> None:
        super().__init__()
        self.mean = mean
        self.log_std = nn.Parameter(torch.full((size,), math.log(std)))
        self.bounds = (math.log(bounds[0]), math.log(bounds[1]))
        self.register_buffer("tie", None if tied_by is None else _means(tied_by), persistent=False)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        loc = self.mean(*inputs)
        tie = self.get_buffer("tie")
        log_std = self.log_std if tie is None else tie.to(self.log_std) @ self.log_std
        return loc, log_std.exp().expand_as(loc)

    @torch.no_grad()
    def keep_in_bounds(self) -> None:
        """Put a deviation that a step has carried beyond its bound back on it."""
        if self.log_std.requires_grad:
            self.log_std.clamp_(*self.bounds)

    @torch.no_grad()
    def begin(self, config: PPOConfig, iteration: int) -> None:
        """Give the deviation the value of an iteration, counted from 1, if it follows a schedule."""
        std = config.scheduled_std(iteration)
        self.log_std.requires_grad_(std is None)
        if std is None:
            self.keep_in_bounds()  # an earlier stage may have had other bounds
        else:
            self.log_std.fill_(math.log(std))


def _means(action: Representation) -> Tensor:
    """The matrix that replaces each entry by the mean of those that it is exchanged or mixed with."""
    same = action.components[:, None] == action.components
    return same.float() / same.sum(1, keepdim=True)


def gaussian(actor: nn.Module) -> Gaussian:
    """The network of an actor of :func:`make_actor`."""
    return next(module for module in actor.modules() if isinstance(module, Gaussian))


def make_actor(
    config: PPOConfig,
    in_keys: Sequence[NestedKey],
    in_size: int,
    out_size: int,
    action: Representation | None = None,
    *,
    observation: Representation | None = None,
    norm: SymmetricNorm | None = None,
    event_dims: Sequence[int] | None = None,
) -> ProbabilisticTensorDictSequential:
    """Gaussian policy on the concatenated inputs; actions are clipped by the environment, if at all.

    Args:
        config: hidden sizes, standard deviation and scale of the initial weights.
        in_keys: what it reads.
        in_size: number of entries it reads.
        out_size: number of actions.
        action: representation of the action, needed for ``config.tie_std`` and for networks that are
            symmetric.
        observation: representation of the concatenated inputs, needed for networks that are symmetric.
        norm: of its inputs, needed for ``config.normalize_observations``.
        event_dims: number of event dimensions of each input. Defaults to one each.

    Raises:
        ValueError: the configuration normalises observations, and there is no ``norm``.
    """
    _require_norm(config, norm)
    net = make_net(config, in_size, out_size, observation, action)
    scale_weights(net, config.weight_scale, config.last_layer_scale)
    mean = FeedForward(net, config.output_scale, norm=norm, event_dims=event_dims)
    bounds = (config.min_std, config.max_std)
    tied_by = action if config.tie_std or config.network == "equivariant" else None
    policy = Gaussian(mean, config.initial_std, out_size, bounds, tied_by)
    return ProbabilisticActor(
        KeyedModule(policy, list(in_keys), ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )


def make_critic(
    config: PPOConfig,
    in_keys: Sequence[NestedKey],
    in_size: int,
    *,
    observation: Representation | None = None,
    norm: SymmetricNorm | None = None,
    event_dims: Sequence[int] | None = None,
) -> KeyedModule:
    """State value on the concatenated inputs; arguments as of :func:`make_actor`."""
    _require_norm(config, norm)
    value = None if observation is None else scalar(observation.group)
    net = make_net(config, in_size, 1, observation, value)
    net = FeedForward(net, norm=norm, event_dims=event_dims)
    return KeyedModule(net, list(in_keys), ["state_value"])


def _require_norm(config: PPOConfig, norm: SymmetricNorm | None) -> None:
    if config.normalize_observations and norm is None:
        raise ValueError(
            "norm: expected a normaliser, since config.normalize_observations is set, got None; pass "
            "SymmetricNorm(*representations of the inputs)"
        )


def make_networks(
    config: PPOConfig, env: EnvBase, symmetry: Symmetry
) -> tuple[ProbabilisticTensorDictSequential, KeyedModule]:
    """Actor and critic that read the observations of the environment that the symmetry declares.

    Which of them actor and critic read, ``config.actor_keys`` and ``config.critic_keys`` say: what a robot
    does not measure (friction, true velocities) may be for the critic only.

    Raises:
        KeyError: the symmetry declares none of the observations, or not one that is asked for.
        TypeError: the action is not one continuous ``"action"``.
    """
    spec = env.full_action_spec.get("action", None)
    if list(env.action_keys) != ["action"] or spec is None or not spec.dtype.is_floating_point:
        raise TypeError(
            f"expected one continuous action under 'action', got {env.full_action_spec}; write a loop with "
            "SymmetricClipPPOLoss for other actions"
        )
    observed = list(env.observation_spec.keys(True, True))
    declared = [key for key in symmetry.keys() if key in observed]  # noqa: SIM118
    if not declared:
        raise KeyError(
            f"the environment observes {observed}, none of which the symmetry declares "
            f"({symmetry.keys()}); add them"
        )
    for name in ("actor_keys", "critic_keys"):
        wrong = [key for key in getattr(config, name) or () if key not in declared]
        if wrong:
            raise KeyError(
                f"{name}: expected observations that the symmetry declares, {declared}, got {wrong}; the "
                f"environment observes {observed}"
            )

    actor_keys, critic_keys = (list(keys or declared) for keys in (config.actor_keys, config.critic_keys))
    size, inputs = _inputs(config, env, symmetry, actor_keys)
    actor = make_actor(config, actor_keys, size, spec.shape[-1], symmetry["action"], **inputs)
    size, inputs = _inputs(config, env, symmetry, critic_keys)
    critic = make_critic(config, critic_keys, size, **inputs)
    return actor.to(config.device), critic.to(config.device)


def _inputs(
    config: PPOConfig, env: EnvBase, symmetry: Symmetry, keys: Sequence[NestedKey]
) -> tuple[int, dict[str, Any]]:
    """Number of entries under some keys, and what a network has to know about them."""
    events = [env.observation_spec[key].shape[env.batch_dims :] for key in keys]
    reps = [symmetry[key] for key in keys]
    norm = SymmetricNorm(*reps) if config.normalize_observations else None
    event_dims = None if all(len(event) == 1 for event in events) else [len(event) for event in events]
    observation = functools.reduce(operator.add, [rep.flatten() for rep in reps])
    about = {"observation": observation, "norm": norm, "event_dims": event_dims}
    return sum(event.numel() for event in events), about
