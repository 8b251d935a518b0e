"""PPO with symmetry, one linear loop of TorchRL parts: collect, estimate advantages, learn.

Read :meth:`_Run.iterations` from top to bottom; everything before it prepares, everything after it helps.
"""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Generator, Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from tqdm import tqdm

from torchrl_sym.checks import function, instance
from torchrl_sym.recipes.checkpoint import (
    own_part,
    random_state,
    require_same_ranks,
    require_same_run,
    restore,
    restore_random,
    snapshot,
    warn_unless_exact,
)
from torchrl_sym.recipes.config import PPOConfig
from torchrl_sym.recipes.environment import MakeEnv, Staggered, measure, offered, seed_unless_own
from torchrl_sym.recipes.fetching import fetch
from torchrl_sym.recipes.finite import finite, require_finite, vital
from torchrl_sym.recipes.learner import Learner
from torchrl_sym.recipes.metrics import SYMMETRY_METRICS, Episodes, symmetry_means
from torchrl_sym.recipes.networks import make_networks
from torchrl_sym.recipes.normalizers import RewardScale, observe
from torchrl_sym.recipes.ranks import Ranks
from torchrl_sym.recipes.storage import RunFolder, make_logger, require_logger
from torchrl_sym.symmetry import Symmetry


class Training(Iterator[dict[str, float]]):
    """A training that is ready: iterate over its metrics, or :meth:`run` it to the end.

    Everything has been checked when it exists; nothing is learned before it is iterated over. It can be
    left at any time, and holds its folder until then.

    Args:
        rows: what it yields, an iteration at a time.
        close: gives up what was prepared.
    """

    def __init__(self, rows: Generator[dict[str, float]], close: Callable[[], None]) -> None:
        self._rows, self._close = rows, close
        self._begun = False

    def __next__(self) -> dict[str, float]:
        self._begun = True
        return next(self._rows)

    def run(self) -> dict[str, float]:
        """Train to the end; returns the last metrics, nothing if the training had ended before.

        Example:
            >>> import functools, tasks
            >>> from torchrl_sym.recipes import PPOConfig, train
            >>> make_env = functools.partial(tasks.make_env, "cartpole", num_threads=1)
            >>> config = PPOConfig(iterations=2, num_envs=8, horizon=8)
            >>> train(config, make_env, make_env(num_envs=1).symmetry).run()["frames"]
            128
        """
        latest: dict[str, float] = {}
        for metrics in self:
            latest = metrics
        return latest

    def close(self) -> None:
        """End it here, and give up its folder; what was learned since the last checkpoint is lost."""
        self._begun = True
        self._rows.close()
        self._close()

    def __del__(self) -> None:
        if not self._begun:
            self.close()
            warnings.warn(
                "a training was prepared but never begun; iterate over train(...), or call its run()",
                RuntimeWarning,
                stacklevel=2,
            )


def train(
    config: PPOConfig,
    make_env: MakeEnv,
    symmetry: Symmetry,
    *,
    folder: str | os.PathLike | None = None,
    start_from: str | os.PathLike | None = None,
    logger: str | None = "csv",
    progress: bool = False,
) -> Training:
    """Prepare a training and check all of it; iterating over it trains, and yields metrics.

    With a folder, the run can be killed at any time and continues when called again, exactly: on one
    thread the metrics are those of a run that was never interrupted. This needs an environment with
    ``save_state()`` and ``restore_state()``, as all of ``tasks`` have, without transforms; others begin
    new episodes when they are continued, with a warning. If the environment has ``stagger()``, it is
    called first, so that batches hold all phases of an episode. What else it may offer:
    :mod:`torchrl_sym.recipes.environment`.

    Called in several processes, as ``torchrun`` starts them, after
    ``torch.distributed.init_process_group``, they share the training (:mod:`torchrl_sym.recipes.ranks`):
    ``config`` is that of the whole, each process has its part of ``config.num_envs``, all yield the same
    metrics, and only the first one writes.

    Args:
        config: hyper-parameters.
        make_env: called with ``num_envs`` and ``seed``. An environment that cannot save its state is seeded
            once more, in case it ignores the latter.
        symmetry: what transforms how. Its observation keys are what actor and critic read, unless
            ``config`` says which of them. Also used, as a metric, when nothing is augmented.
        folder: where metrics and checkpoints go; nothing is written by default. One process at a time can
            train in it.
        start_from: folder of another run, whose networks, optimizer (with its learning rate), running
            episodes and curriculum a new run begins with: to train on with other hyper-parameters, or in
            another version of the task. Its networks and number of environments must be those of
            ``config``.
        logger: ``"csv"`` (metrics.csv only), or also ``"tensorboard"`` or ``"wandb"``.
        progress: show a progress bar.

    Returns:
        A :class:`Training`, which yields one dictionary per iteration: iteration, frames, return (mean of
        the latest finished episodes), mirror_loss, log_prob and log_prob_copies (mean log pi_k of samples
        and of their copies), kl, every loss and diagnostic of the updates, learning_rate, std, seconds,
        frames_per_second, collect_seconds (for this iteration's data; updates and logging take the rest of
        its time); and what the environment's own ``metrics()`` returns, if it has any (success rate, level
        of the curriculum). It raises FloatingPointError when an observation, a loss or a gradient is not
        finite; the last checkpoint is still good then.

    Raises:
        BlockingIOError: another process trains in the folder.
        ValueError: the folder holds a run with another configuration or environment, or a damaged one.
        KeyError, ValueError: the environment and the symmetry do not fit.
        TypeError: the action is not continuous; or an environment's state that no checkpoint can hold.
        FileNotFoundError: there is no checkpoint to start from.

    Example:
        >>> import functools, tasks
        >>> from torchrl_sym.recipes import PPOConfig, train
        >>> make_env = functools.partial(tasks.make_env, "cartpole", num_threads=1)
        >>> symmetry = make_env(num_envs=1).symmetry
        >>> config = PPOConfig(iterations=2, num_envs=8, horizon=8)
        >>> [metrics["frames"] for metrics in train(config, make_env, symmetry)]
        [64, 128]
    """
    instance("config", config, PPOConfig)
    function("make_env", make_env)
    instance("symmetry", symmetry, Symmetry)
    storage = None if folder is None else RunFolder(folder)
    earlier = None if start_from is None else RunFolder(start_from)
    require_logger(logger)
    if storage is not None:
        Ranks().first(storage.lock)
    try:
        run = _Run(config, make_env, symmetry, storage, earlier)
    except BaseException:
        if storage is not None:
            storage.release()
        raise
    return Training(run.iterations(logger, progress), run.close)


class _Run:
    """Environment, learner and folder of one training, as far as they have come."""

    def __init__(
        self,
        config: PPOConfig,
        make_env: MakeEnv,
        symmetry: Symmetry,
        folder: RunFolder | None,
        start_from: RunFolder | None,
    ) -> None:
        self.config, self.folder, self.ranks = config, folder, Ranks()
        share, seed = self.ranks.share("num_envs", config.num_envs), self.ranks.seed(config.seed)
        torch.manual_seed(config.seed)
        self.env = make_env(num_envs=share, seed=seed)
        try:
            seed_unless_own(self.env, seed)
            symmetry.check_specs(self.env)
            self.symmetry = symmetry
            actor, critic = make_networks(config, self.env, self.symmetry)
            self.learner = Learner(config, actor, critic, self.symmetry)
            self.rewards = None
            if config.normalize_rewards:
                self.rewards = RewardScale(config.num_envs, config.gamma).to(config.device)
            self.episodes = Episodes(self.env, self.ranks.count)
            self.done, self.seconds = 0, 0.0
            if self.ranks.index > 0:  # networks were drawn alike, exploration must not be
                torch.manual_seed(seed)
            if not self._continue():
                self._begin(start_from)
            self.random = random_state(config.device)  # of now, whatever is drawn until it begins
        except BaseException:
            self.env.close()
            raise

    @property
    def parts(self) -> dict[str, Any]:
        """What a checkpoint holds of what has been learned, by name."""
        return self.learner.parts | ({} if self.rewards is None else {"rewards": self.rewards})

    def _continue(self) -> bool:
        """Go on from the folder's checkpoint, if it has one that something has been learned for."""
        if self.folder is None:
            return False
        checkpoint = self.ranks.first(self._load)
        if checkpoint is None:
            return False
        self.done, self.seconds = checkpoint["iteration"], checkpoint["seconds"]
        if 0 < self.done < self.config.iterations:
            checkpoint = own_part(checkpoint, self.ranks)
            restore(self.folder, checkpoint, self.env, self.parts, self.episodes)
            restore_random(checkpoint, self.config.device)
            warn_unless_exact(self.env)
        return self.done > 0

    def _load(self) -> dict[str, Any] | None:
        """The checkpoint of this very run, whose table is cut back to it."""
        assert self.folder is not None
        checkpoint = self.folder.load()
        if checkpoint is None:
            self.folder.table.require_empty()
        else:
            require_same_run(self.folder, checkpoint, self.config, self.env, self.ranks)
            self.folder.table.truncate(checkpoint["iteration"])
        return checkpoint

    def _begin(self, start_from: RunFolder | None) -> None:
        """Begin, from another run or with episodes at all of their phases."""
        if start_from is not None:
            earlier, parts = self.ranks.first(start_from.load), self.parts
            found = [] if earlier is None else list(earlier["parts"])
            if earlier is None or set(parts) - set(found):
                raise FileNotFoundError(
                    f"expected a checkpoint with {list(parts)} in {start_from.path} to start from, found "
                    f"{found}; train there first"
                )
            require_same_ranks(start_from, earlier, self.ranks)
            restore(start_from, own_part(earlier, self.ranks), self.env, parts, self.episodes)
            warn_unless_exact(self.env)
        elif (staggered := offered(self.env, Staggered)) is not None:
            staggered.stagger()
        if self.folder is not None:  # also to find now what could not be read back later
            self._save()

    def iterations(self, logger: str | None, progress: bool) -> Generator[dict[str, float]]:
        """Collect and learn, yielding the metrics of every iteration."""
        config, learner = self.config, self.learner
        if self.done >= config.iterations:
            self.close()
            return
        restore_random(self.random, config.device)
        learner.policy.begin(config, self.done + 1)
        # on one device, the collector need not wait for copies
        elsewhere = None if _same(config.device, self.env.device) else config.device
        writes = self.ranks.index == 0
        collector = Collector(
            self.env,
            learner.actor,
            frames_per_batch=self.env.batch_size.numel() * config.horizon,
            total_frames=-1,
            policy_device=elsewhere,
            storing_device=elsewhere,
            auto_register_policy_transforms=False,
            track_traj_ids=False,
        )
        log = make_logger(logger if writes else None, self.folder and self.folder.path, name="train")
        bar = tqdm(total=config.iterations, initial=self.done, disable=not (progress and writes), unit="it")
        began = time.perf_counter()
        clock = began - self.seconds
        try:
            for batch in collector:
                self.done += 1
                data = self.ranks.gather(batch)
                metrics: dict[str, float] = {"iteration": self.done, "frames": self.done * data.numel()}
                metrics["collect_seconds"] = time.perf_counter() - began
                metrics |= self._learn(data)
                self.seconds = metrics["seconds"] = time.perf_counter() - clock
                metrics["frames_per_second"] = metrics["frames"] / metrics["seconds"]
                if self.folder is not None:
                    if writes:
                        self.folder.table.append(metrics)
                    if self.done % config.checkpoint_interval == 0 or self.done >= config.iterations:
                        self._save()
                if log is not None:
                    log.log_metrics(metrics, step=self.done)
                bar.update()
                bar.set_postfix_str(
                    f"return {metrics['return']:.2f} mirror {metrics['mirror_loss']:.3g}", refresh=False
                )
                yield metrics

                if self.done >= config.iterations:
                    break
                learner.policy.begin(config, self.done + 1)
                collector.update_policy_weights_()
                began = time.perf_counter()
        finally:
            bar.close()
            collector.shutdown(close_env=True)
            self.close()

    def _learn(self, data: TensorDictBase) -> dict[str, float]:
        """Measure a batch ``[*env, T]`` and learn from it; the host waits once, when all is queued."""
        learner = self.learner
        names = vital([*learner.actor.in_keys, *learner.critic.in_keys])
        measured = measure(self.env)
        pending = {
            "finite": finite(data, names),
            "reward": data["next", "reward"],
            "done": data["next", "done"],
            "symmetry": symmetry_means(learner.actor, self.symmetry, data),
            "std": data["scale"][..., 0, :].mean(),
            **{f"env {name}": value for name, value in measured.items() if isinstance(value, Tensor)},
        }
        if not self.config.accelerated:  # else it is asked below, with everything else
            require_finite(data, names, pending["finite"])
        pending |= learner.fit(learner.estimate(data if self.rewards is None else self.rewards(data)))
        for network in (learner.actor, learner.critic):
            observe(network, data)

        known = fetch(pending)
        require_finite(data, names, known["finite"])
        measured = {name: float(known.get(f"env {name}", value)) for name, value in measured.items()}
        return {
            "return": self.episodes.add(known["reward"], known["done"]),
            **self.ranks.mean(measured),
            **dict(zip(SYMMETRY_METRICS, known["symmetry"].tolist(), strict=True)),
            **learner.report(known),
            "std": float(known["std"]),
        }

    def _save(self) -> None:
        folder = self.folder
        assert folder is not None
        state = (self.parts, self.episodes, self.done, self.seconds, self.ranks)
        checkpoint = snapshot(self.config, self.env, *state)
        self.ranks.first(lambda: folder.save(checkpoint))

    def close(self) -> None:
        """Give up the folder and the environment."""
        if self.folder is not None:
            self.folder.release()
        if not self.env.is_closed:
            self.env.close()


def _same(device: str, other: torch.device | None) -> bool:
    """Whether the environment's device is that of the networks; ``cuda`` is the current one of its kind."""
    places = [torch.empty(0, device=each or "cpu").device for each in (device, other)]
    return places[0] == places[1]
