"""What learns in the recipe: PPO updates from one batch at a time, at an adaptive rate.

Advantages are estimated once per iteration and before any augmentation: the value of a copy would otherwise
be V(L_g s) and its advantage not the A_k(s, a) of Eq. (sym-aug).

On an accelerator nothing here waits for a number: the rate stays there, as do the numbers that are
reported, and whether those are finite is asked when they are fetched. On the CPU, where nobody waits, it is
asked before the step.
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
from torchrl_sym.recipes.compilation import compiled, recorded
from torchrl_sym.recipes.config import PPOConfig
from torchrl_sym.recipes.fetching import fetch
from torchrl_sym.recipes.networks import gaussian
from torchrl_sym.recipes.optimizer import FusedAdam
from torchrl_sym.recipes.ranks import Ranks
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
        self.ranks = Ranks()
        self.policy = gaussian(actor)
        self.parameters = [*actor.parameters(), *critic.parameters()]
        for parameter in self.parameters:
            self.ranks.adopt(parameter.data)
        self.optimizer = FusedAdam(self.parameters, config.learning_rate, config.accelerated)
        self.losses = make_losses(config, actor, critic, symmetry)
        # TorchRL's faster form looks for the longest episode, and the host would wait for its length
        form = False if config.accelerated else None
        bounds = {"gamma": config.gamma, "lmbda": config.lmbda}
        self.gae = GAE(**bounds, value_network=None, average_gae=True, vectorized=form)
        naive = config.augmentation == "naive"
        self.naive = SymmetryAugment(symmetry, log_prob_from=actor) if naive else None
        self.evaluate, self.update = self._evaluate, self._update
        if config.compile:
            self.evaluate = compiled(self._evaluate, config.device)
            self.update = recorded(self._update, config.device, self.ranks)
        self.names: list[str] = []  # of what an update reports
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
        return self.report(fetch(self.fit(self.estimate(data))))

    @torch.no_grad()
    def estimate(self, data: TensorDictBase) -> TensorDictBase:
        """The rows to learn from, with their advantages and value targets."""
        if self.naive is not None:
            data = self.naive(data)  # before GAE: also the advantage is that of the copies
        estimate_values(self.critic, data, wait=not self.config.accelerated)
        self.gae(data)
        return data.select(*self._keys()).reshape(-1)

    def fit(self, rows: TensorDictBase) -> dict[str, Tensor]:
        """Some epochs of minibatch updates on rows of :meth:`estimate`; :meth:`report` reads the result."""
        minibatches, ranks = self.config.minibatches, self.ranks
        size = ranks.share("rows of a minibatch", len(rows) // minibatches)
        reports: list[Tensor] = []
        for _ in range(self.config.epochs):
            order = ranks.adopt(torch.randperm(len(rows), device=rows.device))
            own = order.reshape(minibatches, ranks.count, size)[:, ranks.index].reshape(-1)
            shuffled = cast("TensorDictBase", rows[own])
            reports += [self.update(minibatch) for minibatch in shuffled.split(size)]
        if self.schedule is not None and self.config.adapt_every == "iteration":
            kl = self.names.index("kl")
            self.schedule.step(torch.stack([report[kl] for report in reports[-minibatches:]]).mean())
        return {"updates": torch.stack(reports), "learning_rate": self.optimizer.rate}

    def report(self, known: dict[str, Tensor]) -> dict[str, float]:
        """What :meth:`learn` returns, of the numbers of :meth:`fit` once they are fetched."""
        table = known["updates"]
        *rows, means = torch.cat([table, table.mean(0, keepdim=True)]).tolist()
        for row in rows:
            self._require_finite(row)
        return dict(zip(self.names, means, strict=True)) | {"learning_rate": float(known["learning_rate"])}

    def _update(self, minibatch: TensorDictBase) -> Tensor:
        """One step of the optimizer; returns losses and diagnostics, in the order of ``names``."""
        out = self.evaluate(minibatch)
        first, *others = (value for key, value in out.items() if key.startswith("loss_"))
        total = sum(others, first)
        for parameter in self.parameters:  # the optimizer's zero_grad() takes ten times as long
            parameter.grad = None
        total.backward()
        # k3, the unbiased estimator of KL(pi_k | pi) that is never negative (Schulman, 2020)
        out["kl"] = out["mean_ratio"] - 1 + out["kl_approx"]
        single = [key for key, value in out.items() if value.numel() == 1 and not key.endswith("_sym")]
        report = torch.stack([out[key].detach().squeeze() for key in single])
        gradients = [parameter.grad for parameter in self.parameters if parameter.grad is not None]
        self.ranks.average([report, *gradients])

        norm = nn.utils.clip_grad_norm_(self.parameters, self.config.max_grad_norm)
        self.names = [*single, "gradient_norm"]
        report = torch.cat([report, norm.reshape(1)])
        if not self.config.accelerated:  # elsewhere the host would wait: they are looked at in the end
            self._require_finite(report.tolist())
        if self.schedule is not None and self.config.adapt_every == "minibatch":
            self.schedule.step(report[single.index("kl")])  # for this very step, as rsl_rl does
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

    def _require_finite(self, report: list[float]) -> None:
        """FloatingPointError if a loss or a gradient is not; a KL that steers nothing may be infinite."""
        steering = {"kl"} if self.schedule is not None else set()
        vital = {
            key: value
            for key, value in zip(self.names, report, strict=True)
            if key.startswith("loss_") or key in {"gradient_norm", *steering}
        }
        if not all(map(math.isfinite, vital.values())):
            raise FloatingPointError(
                f"expected finite losses and gradients, got {vital}; lower learning_rate or "
                "max_learning_rate, or bound the std"
            )

    def _keys(self) -> list:
        own = ["action", *self.actor.log_prob_keys, "advantage", "value_target", "state_value"]
        return list(dict.fromkeys([*self.actor.in_keys, *self.critic.in_keys, *own]))


def estimate_values(critic: TensorDictModule, data: TensorDictBase, *, wait: bool = True) -> None:
    """Write V of every state and next state of a batch ``[*env, T]``.

    A next state is the state of the row after it, except where an episode ends and in the last row. To know
    which those are, the host has to wait; if it must not, the critic evaluates all of them.
    """
    keys = critic.in_keys
    data["state_value"] = critic(data.select(*keys))["state_value"]
    nexts = cast("TensorDictBase", data["next"])
    if not wait:
        nexts["state_value"] = critic(nexts.select(*keys))["state_value"]
        return
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
