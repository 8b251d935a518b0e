"""What learns in the recipe: PPO updates from one batch at a time, at an adaptive rate.

Advantages are estimated once per iteration and before any augmentation: the value of a copy would otherwise
be V(L_g s) and its advantage not the A_k(s, a) of Eq. (sym-aug).
"""

from __future__ import annotations

import math
from contextlib import nullcontext
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import LossModule
from torchrl.objectives.value import GAE

from torchrl_sym.augment import SymmetryAugment
from torchrl_sym.mirror_loss import MirrorLoss
from torchrl_sym.modules.linear import relaxation
from torchrl_sym.recipes.compilation import compiled
from torchrl_sym.recipes.config import PPOConfig
from torchrl_sym.recipes.networks import gaussian
from torchrl_sym.recipes.rate import AdaptiveRate
from torchrl_sym.symmetric_ppo import SymmetricClipPPOLoss
from torchrl_sym.symmetry import Symmetry


class Learner:
    """Losses, optimizer and learning rate of the recipe.

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
        critic: TensorDictModule,
        symmetry: Symmetry,
    ) -> None:
        self.config, self.actor, self.critic = config, actor, critic
        self.policy = gaussian(actor)
        self.parameters = [*actor.parameters(), *critic.parameters()]
        self.optimizer = torch.optim.Adam(self.parameters, lr=config.learning_rate, fused=True)
        self.losses = make_losses(config, actor, critic, symmetry)
        self.gae = GAE(gamma=config.gamma, lmbda=config.lmbda, value_network=None, average_gae=True)
        naive = config.augmentation == "naive"
        self.naive = SymmetryAugment(symmetry, log_prob_from=actor) if naive else None
        self.evaluate = compiled(self._evaluate, config.device) if config.compile else self._evaluate
        self.schedule = None
        if config.desired_kl is not None:
            bounds = {"low": config.min_learning_rate, "high": config.max_learning_rate}
            self.schedule = AdaptiveRate(self.optimizer, config.desired_kl, **bounds)

    @property
    def parts(self) -> dict[str, Any]:
        """What a checkpoint holds of it, by name."""
        return {"actor": self.actor, "critic": self.critic, "optimizer": self.optimizer}

    def learn(self, data: TensorDictBase) -> dict[str, float]:
        """Some epochs of minibatch updates on a batch ``[*env, T]`` of the collector.

        Returns:
            The mean of every loss and diagnostic over the updates, and the learning rate at the end.

        Raises:
            FloatingPointError: a loss or its gradient is not finite; on the CPU, the parameters are those
                before it, elsewhere it is noticed at the end of the iteration.
        """
        return self.fit(self.estimate(data))

    @torch.no_grad()
    def estimate(self, data: TensorDictBase) -> TensorDictBase:
        """The rows to learn from, with their advantages and value targets."""
        if self.naive is not None:
            data = self.naive(data)  # before GAE: also the advantage is that of the copies
        estimate_values(self.critic, data)
        self.gae(data)
        return data.select(*self._keys()).reshape(-1)

    def fit(self, rows: TensorDictBase) -> dict[str, float]:
        """Some epochs of minibatch updates on rows of :meth:`estimate`; returns what :meth:`learn` does."""
        size = len(rows) // self.config.minibatches
        reports: list[dict[str, Tensor]] = []
        for _ in range(self.config.epochs):
            shuffled = cast("TensorDictBase", rows[torch.randperm(len(rows), device=rows.device)])
            reports += [self._update(minibatch) for minibatch in shuffled.split(size)]
        if self.schedule is not None and self.config.adapt_every == "iteration":
            last = reports[-self.config.minibatches :]
            self.schedule.step(torch.stack([report["kl"] for report in last]).mean())
        return self._means(reports) | {"learning_rate": self._settled_rate()}

    def _update(self, minibatch: TensorDictBase) -> dict[str, Tensor]:
        """One step of the optimizer; returns the losses and diagnostics that are single numbers."""
        out = self.evaluate(minibatch)
        first, *others = (value for key, value in out.items() if key.startswith("loss_"))
        total = sum(others, first)
        for parameter in self.parameters:  # the optimizer's zero_grad() takes ten times as long
            parameter.grad = None
        total.backward()
        norm = nn.utils.clip_grad_norm_(self.parameters, self.config.max_grad_norm)
        # k3, the unbiased estimator of KL(pi_k | pi) that is never negative (Schulman, 2020)
        out["kl"] = out["mean_ratio"] - 1 + out["kl_approx"]
        single = (key for key, value in out.items() if value.numel() == 1 and not key.endswith("_sym"))
        report = {key: out[key].detach().squeeze() for key in single}
        report["gradient_norm"] = norm
        if norm.device.type == "cpu":  # elsewhere the host would wait: they are looked at in the end
            self._require_finite({key: value.item() for key, value in self._vital(report).items()})

        if self.schedule is not None and self.config.adapt_every == "minibatch":
            self.schedule.step(out["kl"])  # for this very step, as rsl_rl does: not one step late
        self.optimizer.step()
        self.policy.keep_in_bounds()
        return report

    def _evaluate(self, minibatch: TensorDictBase) -> dict[str, Tensor]:
        """All losses of a minibatch and their diagnostics."""
        with self._precision():
            out = {key: value for loss in self.losses for key, value in loss(minibatch).items()}
        if self.config.network == "relaxed":
            departed = relaxation(self.actor) + relaxation(self.critic)
            out["loss_relaxation"] = self.config.relaxation_coeff * departed
        return out

    def _precision(self) -> torch.autocast | nullcontext:
        if self.config.autocast is None:
            return nullcontext()
        kind = torch.device(self.config.device).type
        return torch.autocast(kind, dtype=getattr(torch, self.config.autocast))

    def _means(self, reports: list[dict[str, Tensor]]) -> dict[str, float]:
        """Means over the updates, fetched at once."""
        names = list(reports[0])
        table = torch.stack([torch.stack([report[name] for name in names]) for report in reports])
        *rows, means = torch.cat([table, table.mean(0, keepdim=True)]).tolist()
        for row in rows:
            self._require_finite(self._vital(dict(zip(names, row, strict=True))))
        return dict(zip(names, means, strict=True))

    def _vital(self, report: dict[str, Any]) -> dict[str, Any]:
        """What must be finite; a KL that steers nothing may be infinite."""
        steering = {"kl"} if self.schedule is not None else set()
        return {
            key: value
            for key, value in report.items()
            if key.startswith("loss_") or key in {"gradient_norm", *steering}
        }

    def _require_finite(self, numbers: dict[str, float]) -> None:
        if not all(map(math.isfinite, numbers.values())):
            raise FloatingPointError(
                f"expected finite losses and gradients, got {numbers}; lower learning_rate or "
                "max_learning_rate, or bound the std"
            )

    def _settled_rate(self) -> float:
        """The learning rate as the number that a checkpoint holds."""
        for group in self.optimizer.param_groups:
            group["lr"] = float(group["lr"])
        return self.optimizer.param_groups[0]["lr"]

    def _keys(self) -> list:
        own = ["action", *self.actor.log_prob_keys, "advantage", "value_target", "state_value"]
        return list(dict.fromkeys([*self.actor.in_keys, *self.critic.in_keys, *own]))


def estimate_values(critic: TensorDictModule, data: TensorDictBase) -> None:
    """Write V of every state and next state of a batch ``[*env, T]``, in one pass of the critic.

    A next state is the state of the row after it, except where an episode ends and in the last row.
    """
    keys = critic.in_keys
    data["state_value"] = critic(data.select(*keys))["state_value"]
    nexts = cast("TensorDictBase", data["next"])
    apart = nexts["done"].squeeze(-1).clone()
    apart[..., -1] = True
    value = torch.cat([data["state_value"][..., 1:, :], data["state_value"][..., :1, :]], dim=-2)
    value[apart] = critic(nexts.select(*keys)[apart])["state_value"]
    nexts["state_value"] = value


def make_losses(
    config: PPOConfig,
    actor: ProbabilisticTensorDictSequential,
    critic: TensorDictModule,
    symmetry: Symmetry,
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
    # without copies, ClipPPOLoss to the last bit, in a twentieth less time
    kwargs["elements"] = [symmetry.group.names[0]]
    losses: list[LossModule] = [SymmetricClipPPOLoss(actor, critic, symmetry=symmetry, **kwargs)]
    if config.mirror_coeff > 0:
        losses.append(MirrorLoss(actor, symmetry=symmetry, coeff=config.mirror_coeff, functional=False))
    return losses
