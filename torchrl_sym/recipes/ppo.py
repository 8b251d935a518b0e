"""PPO with symmetry, one linear loop of TorchRL parts: collect, estimate advantages, learn.

Read :func:`train` from top to bottom; the helpers below it are in the order of their use. Advantages are
estimated once per iteration and before any augmentation: the value of a copy would otherwise be V(L_g s)
and its advantage not the A_k(s, a) of Eq. (sym-aug).
"""

from __future__ import annotations

import copy
import dataclasses
import math
import os
import time
from collections.abc import Iterator
from typing import Any, Protocol

import torch
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.envs import EnvBase
from torchrl.modules import ValueOperator
from torchrl.objectives import ClipPPOLoss, KLAdaptiveLR, LossModule
from torchrl.objectives.value import GAE
from tqdm import tqdm

from torchrl_sym.mirror_loss import MirrorLoss
from torchrl_sym.recipes.config import PPOConfig
from torchrl_sym.recipes.metrics import Episodes, symmetry_metrics
from torchrl_sym.recipes.networks import make_actor, make_critic
from torchrl_sym.recipes.resume import call_env, resume, snapshot
from torchrl_sym.recipes.storage import RunFolder, make_logger
from torchrl_sym.symmetric_ppo import SymmetricClipPPOLoss
from torchrl_sym.symmetry import Symmetry
from torchrl_sym.transforms import SymmetryAugment


class MakeEnv(Protocol):
    """Makes the training environment, e.g. ``functools.partial(tasks.make_env, "cartpole")``."""

    def __call__(self, *, num_envs: int, seed: int) -> EnvBase: ...


def train(
    config: PPOConfig,
    make_env: MakeEnv,
    symmetry: Symmetry,
    *,
    folder: str | os.PathLike | None = None,
    start_from: str | os.PathLike | None = None,
    logger: str | None = "csv",
    progress: bool = False,
) -> Iterator[dict[str, float]]:
    """Train, yielding one dictionary of metrics per iteration.

    With a folder, the run can be killed at any time and continues when called again, exactly: on one
    thread the metrics are those of a run that was never interrupted. This needs an environment with
    ``save_state()`` and ``restore_state()``, as all of ``tasks`` have, without transforms; others begin
    new episodes when they are continued, with a warning. If the environment has ``stagger()``, it is
    called first, so that batches hold all phases of an episode.

    Args:
        config: hyper-parameters.
        make_env: called with ``num_envs`` and ``seed``.
        symmetry: what transforms how. Its observation keys are what actor and critic read. Also used,
            as a metric, when nothing is augmented.
        folder: where metrics and checkpoints go; nothing is written by default.
        start_from: folder of another run, whose networks, optimizer (with its learning rate), running
            episodes and curriculum a new run begins with: to train on with other hyper-parameters, or in
            another version of the task. Its networks and number of environments must be those of
            ``config``.
        logger: ``"csv"`` (metrics.csv only), or also ``"tensorboard"`` or ``"wandb"``.
        progress: show a progress bar.

    Yields:
        iteration, frames, return (mean of the latest finished episodes), mirror_loss, log_prob and
        log_prob_copies (mean log pi_k of samples and of their copies), kl, every loss and diagnostic of
        the updates, learning_rate, std, seconds, frames_per_second, collect_seconds (for this
        iteration's data; updates and logging take the rest of its time); and what the environment's own
        ``metrics()`` returns, if it has any (success rate, level of the curriculum).

    Raises:
        ValueError: the folder holds a run with another configuration.
        KeyError, ValueError: the environment and the symmetry do not fit.
        TypeError: the action is not continuous.
        FileNotFoundError: there is no checkpoint to start from.
        FloatingPointError: a loss is not finite; the last checkpoint is still good.

    Example:
        >>> import functools, tasks
        >>> from torchrl_sym.recipes import PPOConfig, train
        >>> make_env = functools.partial(tasks.make_env, "cartpole", num_threads=1)
        >>> symmetry = make_env(num_envs=1).symmetry
        >>> config = PPOConfig(iterations=2, num_envs=8, horizon=8)
        >>> [metrics["frames"] for metrics in train(config, make_env, symmetry)]
        [64, 128]
    """
    torch.manual_seed(config.seed)
    env = make_env(num_envs=config.num_envs, seed=config.seed)
    symmetry.check_specs(env)
    symmetry = copy.deepcopy(symmetry).to(config.device)
    actor, critic = make_networks(config, env, symmetry)
    parameters = [*actor.parameters(), *critic.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=config.learning_rate, fused=True)
    losses = make_loss(config, actor, critic, symmetry)
    gae = GAE(gamma=config.gamma, lmbda=config.lmbda, value_network=critic, average_gae=True)
    naive = SymmetryAugment(symmetry, log_prob_from=actor) if config.augmentation == "naive" else None
    rows = config.num_envs * config.horizon * (symmetry.group.order if naive else 1)
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(rows, device=config.device),
        sampler=SamplerWithoutReplacement(),
        batch_size=rows // config.minibatches,
    )
    schedule = _schedule(config, optimizer)
    episodes = Episodes(env)
    run = None if folder is None else RunFolder(folder)
    parts = {"actor": actor, "critic": critic, "optimizer": optimizer}
    earlier = None if start_from is None else RunFolder(start_from)
    start, elapsed = resume(run, config, env, parts, episodes, earlier)
    if start >= config.iterations:
        env.close()
        return
    collector = Collector(
        env,
        actor,
        frames_per_batch=config.num_envs * config.horizon,
        total_frames=-1,
        policy_device=None if config.device == "cpu" else config.device,
        storing_device=None if config.device == "cpu" else config.device,
        auto_register_policy_transforms=False,
    )
    log = make_logger(logger, folder, name="train")
    bar = tqdm(total=config.iterations, initial=start, disable=not progress, unit="it")
    began = time.perf_counter()
    clock = began - elapsed
    try:
        for iteration, data in enumerate(collector, start + 1):
            metrics = {"iteration": iteration, "frames": iteration * data.numel()}
            metrics["collect_seconds"] = time.perf_counter() - began
            metrics["return"] = episodes.update(data)
            metrics |= call_env(env, "metrics") or {}
            metrics |= symmetry_metrics(actor, symmetry, data)
            if naive is not None:
                data = naive(data)  # before GAE: also the advantage is that of the copies
            with torch.no_grad():
                gae(data)
            buffer.empty()  # the sampler keeps a permutation drawn ahead, which no checkpoint would have
            buffer.extend(data.select(*_batch_keys(actor, critic)).reshape(-1))
            metrics |= _learn(config, losses, buffer, optimizer, schedule, parameters)
            metrics["std"] = float(data["scale"][..., 0, :].mean())
            metrics["seconds"] = time.perf_counter() - clock
            metrics["frames_per_second"] = metrics["frames"] / metrics["seconds"]
            if run is not None:
                run.append(metrics)
                if iteration % config.checkpoint_interval == 0 or iteration >= config.iterations:
                    run.save(snapshot(config, env, parts, episodes, iteration, metrics["seconds"]))
            if log is not None:
                log.log_metrics(metrics, step=iteration)
            bar.update()
            bar.set_postfix_str(
                f"return {metrics['return']:.2f} mirror {metrics['mirror_loss']:.3g}", refresh=False
            )
            yield metrics
            if iteration >= config.iterations:
                break
            collector.update_policy_weights_()
            began = time.perf_counter()
    finally:
        bar.close()
        collector.shutdown(close_env=True)


def make_networks(
    config: PPOConfig, env: EnvBase, symmetry: Symmetry
) -> tuple[ProbabilisticTensorDictSequential, ValueOperator]:
    """Actor and critic that read every observation of the environment that the symmetry declares.

    Raises:
        KeyError: the symmetry declares none of the observations.
        TypeError: the action is not one continuous ``"action"``.
    """
    spec = env.full_action_spec.get("action", None)
    if list(env.action_keys) != ["action"] or spec is None or not spec.dtype.is_floating_point:
        raise TypeError(
            f"expected one continuous action under 'action', got {env.full_action_spec}; write a loop with "
            "SymmetricClipPPOLoss for other actions"
        )
    keys = [key for key in symmetry.keys() if key in env.observation_spec.keys(True, True)]  # noqa: SIM118
    if not keys:
        raise KeyError(
            f"the environment observes {list(env.observation_spec.keys(True, True))}, none of which the "
            f"symmetry declares ({symmetry.keys()}); add them"
        )
    size = sum(env.observation_spec[key].shape[-1] for key in keys)
    actor = make_actor(config, keys, size, spec.shape[-1], symmetry["action"]).to(config.device)
    return actor, make_critic(config, keys, size).to(config.device)


def load_actor(
    folder: str | os.PathLike, env: EnvBase, symmetry: Symmetry
) -> ProbabilisticTensorDictSequential:
    """The trained policy of a run.

    Args:
        folder: where :func:`train` wrote its checkpoint.
        env: an environment with the observations and actions of the training environment.
        symmetry: the symmetry that was passed to :func:`train`.

    Raises:
        FileNotFoundError: there is no checkpoint.
    """
    checkpoint = RunFolder(folder).load()
    if checkpoint is None:
        raise FileNotFoundError(f"expected a checkpoint in {folder}, found none; train there first")
    stored = {name: _tuple(value) for name, value in checkpoint["config"].items()}
    actor, _ = make_networks(dataclasses.replace(PPOConfig(**stored), device="cpu"), env, symmetry)
    actor.load_state_dict(checkpoint["parts"]["actor"])
    return actor


def export_actor(folder: str | os.PathLike, target: str | os.PathLike) -> None:
    """Keep only the policy of a run: a checkpoint that :func:`load_actor` reads, a tenth of the size.

    Args:
        folder: where :func:`train` wrote its checkpoint.
        target: folder of the new checkpoint; created if missing.

    Raises:
        FileNotFoundError: there is no checkpoint.
    """
    checkpoint = RunFolder(folder).load()
    if checkpoint is None:
        raise FileNotFoundError(f"expected a checkpoint in {folder}, found none; train there first")
    parts = {"actor": checkpoint["parts"]["actor"]}
    kept = {name: checkpoint[name] for name in ("config", "iteration", "seconds")}
    RunFolder(target).save({**kept, "parts": parts})


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def make_loss(
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


def _batch_keys(actor: ProbabilisticTensorDictSequential, critic: ValueOperator) -> list:
    own = ["action", *actor.log_prob_keys, "advantage", "value_target", "state_value"]
    return list(dict.fromkeys([*actor.in_keys, *critic.in_keys, *own]))


def _learn(
    config: PPOConfig,
    losses: list[LossModule],
    buffer: ReplayBuffer,
    optimizer: torch.optim.Optimizer,
    schedule: KLAdaptiveLR | None,
    parameters: list[nn.Parameter],
) -> dict[str, float]:
    """Some epochs of minibatch updates; returns the mean of every reported quantity."""
    sums: dict[str, Tensor] = {}
    updates = config.epochs * config.minibatches
    last = torch.zeros(())
    for epoch in range(config.epochs):
        for minibatch in buffer:
            out = {key: value for loss in losses for key, value in loss(minibatch).items()}
            total = torch.stack([value for key, value in out.items() if key.startswith("loss_")]).sum()
            optimizer.zero_grad()
            total.backward()
            norm = nn.utils.clip_grad_norm_(parameters, config.max_grad_norm)
            if not norm.isfinite():
                raise FloatingPointError(
                    f"the gradient is {norm.item()}, with losses "
                    f"{ {k: v.item() for k, v in out.items() if k.startswith('loss_')} }; lower "
                    "learning_rate or max_learning_rate, or bound the std"
                )
            optimizer.step()
            # k3, the unbiased estimator of KL(pi_k | pi) that is never negative (Schulman, 2020)
            out["kl"] = out["mean_ratio"] - 1 + out["kl_approx"]
            if schedule is not None and config.adapt_every == "minibatch":
                schedule.step(out["kl"])
            if epoch == config.epochs - 1:
                last = last + out["kl"].detach() / config.minibatches
            for key, value in out.items():
                if value.numel() == 1:
                    sums[key] = sums.get(key, 0.0) + value.detach()
    if schedule is not None and config.adapt_every == "iteration":
        schedule.step(last)
    metrics = {key: float(value) / updates for key, value in sums.items()}
    return metrics | {"learning_rate": optimizer.param_groups[0]["lr"]}


def _schedule(config: PPOConfig, optimizer: torch.optim.Optimizer) -> KLAdaptiveLR | None:
    if config.desired_kl is None:
        return None
    bounds = {"min_lr": config.min_learning_rate, "max_lr": config.max_learning_rate}
    return KLAdaptiveLR(optimizer, config.desired_kl, **bounds)
