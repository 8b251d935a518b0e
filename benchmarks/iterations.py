"""A whole iteration of training, and its updates, against rsl_rl on the same simulation.

One table of speed.py. Both sides run in turn, round by round, on one thread; what counts is the time of the
processor, not that of the clock, which other processes share.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Iterator
from statistics import median
from typing import Any

import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

import tasks
from measuring import interleave, ratio
from peer import INSTALLED, Peer
from tasks.settings import SETTINGS
from torchrl_sym.recipes import PPOConfig, train
from torchrl_sym.recipes.learner import Learner
from torchrl_sym.recipes.networks import make_networks

TASKS = ("cartpole", "anymal_push", "anymal_climb")


def measure_iterations(names: tuple[str, ...], rounds: int) -> Iterator[dict]:
    """Milliseconds of an update and of an iteration, and ratios to rsl_rl's."""
    for task, augmentation, config, make_env in cases(names):
        yield {"task": task, "augmentation": augmentation, **compare(config, make_env, rounds)}


def compare(config: PPOConfig, make_env: Callable, rounds: int) -> dict[str, float | None]:
    """Milliseconds and ratios, which are None where rsl_rl is not installed."""
    training = train(config, make_env, make_env(num_envs=1).symmetry)
    update, steps = our_update(config, make_env), config.epochs * config.minibatches
    variants: dict[str, Callable[[], object]] = {"iteration": lambda: next(training), "update": update}
    if INSTALLED:
        peers = {"": Peer(config, make_env(num_envs=config.num_envs, seed=0))}
        if config.augmentation == "all":
            env = make_env(num_envs=config.num_envs, seed=0)
            peers["_no_metric"] = Peer(config, env, metric=False)
        for name, peer in peers.items():
            peer.collect()
            variants |= {f"their_update{name}": peer.learn, f"their_iteration{name}": peer.iterate}

    seconds = interleave(variants, rounds, time.process_time)
    training.close()
    row = {
        "step_ms": 1e3 * median(seconds["update"]) / steps,
        "iteration_ms": 1e3 * median(seconds["iteration"]),
    }
    for ours, short in (("update", "step"), ("iteration", "iteration")):
        for suffix in ("", "_no_metric"):
            row[f"{short}_over_rsl{suffix}"] = ratio(seconds, ours, f"their_{ours}{suffix}")
    return row


def our_update(config: PPOConfig, make_env: Callable) -> Callable[[], object]:
    """All epochs on the same rows."""
    torch.manual_seed(0)
    env = make_env(num_envs=config.num_envs, seed=0)
    actor, critic = make_networks(config, env, env.symmetry)
    learner = Learner(config, actor, critic, env.symmetry)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        data = env.rollout(config.horizon, actor, break_when_any_done=False)
    return functools.partial(learner.fit, learner.estimate(data))


def measure_options(names: tuple[str, ...], rounds: int) -> Iterator[dict]:
    """Processor time of all epochs with an option, over that without."""
    choices = {
        "compile": {"compile": True},
        "bfloat16": {"autocast": "bfloat16"},
        "both": {"compile": True, "autocast": "bfloat16"},
    }
    for task, augmentation, config, make_env in cases(names):
        variants = {"default": our_update(config, make_env)}
        for name, options in choices.items():
            variants[name] = our_update(dataclasses.replace(config, **options), make_env)
        seconds = interleave(variants, rounds, time.process_time)
        ratios = {name: ratio(seconds, name, "default") for name in choices}
        yield {"task": task, "augmentation": augmentation, **ratios}


def cases(names: tuple[str, ...]) -> Iterator[tuple[str, str, PPOConfig, Callable]]:
    """Tasks, each plain and with all copies, with their settings."""
    for task in (name for name in names if name in TASKS):
        setting = SETTINGS[task]
        make_env = functools.partial(tasks.make_env, task, num_threads=1, **setting.task)
        for augmentation in ("none", "all"):
            changes: dict[str, Any] = {"iterations": 10**9, "augmentation": augmentation}
            yield task, augmentation, dataclasses.replace(setting.config, **changes), make_env
