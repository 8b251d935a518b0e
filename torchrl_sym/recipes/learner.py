"""What learns in the recipe: PPO updates from one batch at a time, at an adaptive rate.

Advantages are estimated once per iteration and before any augmentation: the value of a copy would otherwise
be V(L_g s) and its advantage not the A_k(s, a) of Eq. (sym-aug).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.modules import ValueOperator
from torchrl.objectives import ClipPPOLoss, KLAdaptiveLR, LossModule
from torchrl.objectives.value import GAE

from torchrl_sym.augment import SymmetryAugment
from torchrl_sym.mirror_loss import MirrorLoss
from torchrl_sym.recipes.config import PPOConfig
from torchrl_sym.recipes.networks import gaussian
from torchrl_sym.symmetric_ppo import SymmetricClipPPOLoss
from torchrl_sym.symmetry import Symmetry


class Learner:
    """Losses, buffer, optimizer and learning rate of the recipe.

    Args:
        config: hyper-parameters.
        actor: the policy, of :func:`~torchrl_sym.recipes.make_actor`.
        critic: the state value.
        symmetry: what transforms how, on ``config.device``.
    """

    def __init__(
        self,
        config: PPOConfig,
        actor: ProbabilisticTensorDictSequential,
        critic: ValueOperator,
        symmetry: Symmetry,
    ) -> None:
        self.config, self.actor, self.critic = config, actor, critic
        self.policy = gaussian(actor)
        self.parameters = [*actor.parameters(), *critic.parameters()]
        self.optimizer = torch.optim.Adam(self.parameters, lr=config.learning_rate, fused=True)
        self.losses = make_losses(config, actor, critic, symmetry)
        self.gae = GAE(gamma=config.gamma, lmbda=config.lmbda, value_network=critic, average_gae=True)
        naive = config.augmentation == "naive"
        self.naive = SymmetryAugment(symmetry, log_prob_from=actor) if naive else None

        rows = config.num_envs * config.horizon * (symmetry.group.order if naive else 1)
        self.buffer = ReplayBuffer(
            storage=LazyTensorStorage(rows, device=config.device),
            sampler=SamplerWithoutReplacement(),
            batch_size=rows // config.minibatches,
        )
        self.schedule = None
        if config.desired_kl is not None:
            bounds = {"min_lr": config.min_learning_rate, "max_lr": config.max_learning_rate}
            self.schedule = KLAdaptiveLR(self.optimizer, config.desired_kl, **bounds)

    @property
    def parts(self) -> dict[str, Any]:
        """What a checkpoint holds of it, by name."""
        return {"actor": self.actor, "critic": self.critic, "optimizer": self.optimizer}

    def learn(self, data: TensorDictBase) -> dict[str, float]:
        """Some epochs of minibatch updates on a batch ``[*env, T]`` of the collector.

        Returns:
            The mean of every loss and diagnostic over the updates, and the learning rate at the end.

        Raises:
            FloatingPointError: a loss or its gradient is not finite; the parameters are those before it.
        """
        if self.naive is not None:
            data = self.naive(data)  # before GAE: also the advantage is that of the copies
        with torch.no_grad():
            self.gae(data)
        self.buffer.empty()  # the sampler keeps a permutation drawn ahead, which no checkpoint would have
        with _quiet():
            self.buffer.extend(data.select(*self._keys()).reshape(-1))

        reports: list[dict[str, Tensor]] = []
        for _ in range(self.config.epochs):
            reports += [self._update(minibatch) for minibatch in self.buffer]
        if self.schedule is not None and self.config.adapt_every == "iteration":
            last = reports[-self.config.minibatches :]
            self.schedule.step(torch.stack([report["kl"] for report in last]).mean())
        means = {key: float(torch.stack([each[key] for each in reports]).mean()) for key in reports[0]}
        return means | {"learning_rate": self.optimizer.param_groups[0]["lr"]}

    def _update(self, minibatch: TensorDictBase) -> dict[str, Tensor]:
        """One step of the optimizer; returns the losses and diagnostics that are single numbers."""
        out = {key: value for loss in self.losses for key, value in loss(minibatch).items()}
        total = torch.stack([value for key, value in out.items() if key.startswith("loss_")]).sum()
        self.optimizer.zero_grad()
        total.backward()
        norm = nn.utils.clip_grad_norm_(self.parameters, self.config.max_grad_norm)
        # k3, the unbiased estimator of KL(pi_k | pi) that is never negative (Schulman, 2020)
        out["kl"] = out["mean_ratio"] - 1 + out["kl_approx"]
        steering = 0.0 if self.schedule is None else out["kl"]  # one that is only reported may be inf
        if not (norm + total + steering).isfinite():
            numbers = {key: v.item() for key, v in out.items() if key.startswith("loss_") or key == "kl"}
            raise FloatingPointError(
                f"expected finite losses and gradients, got {numbers} and a gradient of norm "
                f"{norm.item()}; lower learning_rate or max_learning_rate, or bound the std"
            )

        if self.schedule is not None and self.config.adapt_every == "minibatch":
            self.schedule.step(out["kl"])  # for this very step, as rsl_rl does: not one step late
        self.optimizer.step()
        self.policy.keep_in_bounds()
        return {key: value.detach().squeeze() for key, value in out.items() if value.numel() == 1}

    def _keys(self) -> list:
        own = ["action", *self.actor.log_prob_keys, "advantage", "value_target", "state_value"]
        return list(dict.fromkeys([*self.actor.in_keys, *self.critic.in_keys, *own]))


def make_losses(
    config: PPOConfig, actor: ProbabilisticTensorDictSequential, critic: ValueOperator, symmetry: Symmetry
) -> list[LossModule]:
    """The losses to add up: PPO with or without copies, and a mirror loss where none is built in."""
    kwargs: dict[str, Any] = {
        "clip_epsilon": config.clip_epsilon,
        "clip_value": config.clip_value,
        "critic_coeff": config.critic_coeff,
        "entropy_coeff": config.entropy_coeff,
        "loss_critic_type": "l2",
        "functional": False,  # swapping parameters in and out costs a tenth of a small update
    }
    if config.augmentation in ("all", "random"):
        kwargs |= {"elements": config.augmentation, "mirror_coeff": config.mirror_coeff}
        return [SymmetricClipPPOLoss(actor, critic, symmetry=symmetry, **kwargs)]
    if config.augmentation == "naive" and math.isfinite(config.max_log_ratio):
        kwargs["max_importance_ratio"] = math.exp(config.max_log_ratio)
    losses: list[LossModule] = [ClipPPOLoss(actor, critic, **kwargs)]
    if config.mirror_coeff > 0:
        losses.append(MirrorLoss(actor, symmetry=symmetry, coeff=config.mirror_coeff, functional=False))
    return losses


@contextmanager
def _quiet() -> Iterator[None]:
    """Without TorchRL's messages, the first of which would cut a progress bar in two."""
    logger = logging.getLogger("torchrl")
    level = logger.level
    logger.setLevel(max(level, logging.WARNING))
    try:
        yield
    finally:
        logger.setLevel(level)
