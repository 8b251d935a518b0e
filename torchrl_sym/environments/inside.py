"""What an environment is made of: its transforms, wherever they are, also those inside workers.

TorchRL's environments nest: transforms around an environment, around a batch of worker environments, around
environments with transforms of their own. :func:`inside` opens one shell of it, :func:`transforms_of` all.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
import torch
from torchrl.envs import (
    AsyncEnvPool,
    Compose,
    EnvBase,
    ParallelEnv,
    SerialEnv,
    ThreadingAsyncEnvPool,
    Transform,
    TransformedEnv,
)

from torchrl_sym._torchrl import serial_workers


def transforms_of(env: EnvBase) -> list[Transform]:
    """All transforms of an environment, the innermost first, also those of its workers.

    Of workers in other processes, one environment of each maker is built to look inside, and closed.

    Example:
        >>> import tasks
        >>> from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv
        >>> env = tasks.make_env("cartpole", num_envs=2, num_threads=1)
        >>> env = TransformedEnv(env, Compose(RewardSum(), StepCounter()))
        >>> [type(transform).__name__ for transform in transforms_of(env)]
        ['RewardSum', 'StepCounter']
    """
    with inside(env) as inner:
        below = [transform for each in inner for transform in transforms_of(each)]
    return below + shell(env)


def shell(env: EnvBase) -> list[Transform]:
    """The transforms directly around an environment, the innermost first, those of a Compose one by one."""
    return _flat(env.transform) if isinstance(env, TransformedEnv) else []


def _flat(transform: Any) -> list[Transform]:
    if isinstance(transform, Compose):
        return [leaf for each in transform.transforms for leaf in _flat(each)]
    return [] if transform is None else [transform]


@contextmanager
def inside(env: EnvBase) -> Iterator[list[EnvBase]]:
    """The environments directly inside another: what is transformed, or one worker of each maker."""
    with ExitStack() as stack:
        if isinstance(env, TransformedEnv):
            found = [env.base_env]
        elif isinstance(env, SerialEnv):
            found = serial_workers(env)
        elif isinstance(env, ThreadingAsyncEnvPool):
            found = env.envs
        elif isinstance(env, ParallelEnv | AsyncEnvPool):
            makers = env.create_env_fn if isinstance(env, ParallelEnv) else env.env_makers
            found = []
            pairs = zip(makers, env.create_env_kwargs, strict=True)
            for maker, kwargs in {id(maker): (maker, kwargs) for maker, kwargs in pairs}.values():
                if isinstance(maker, EnvBase):
                    found.append(maker)
                    continue
                with undisturbed():
                    found.append(maker(**kwargs))
                stack.callback(close, found[-1])
        else:
            found = []
        yield found


@contextmanager
def undisturbed() -> Iterator[None]:
    """Leave the global random generators as they were."""
    python, array = random.getstate(), np.random.get_state()
    with torch.random.fork_rng(range(torch.cuda.device_count()) if torch.cuda.is_initialized() else []):
        try:
            yield
        finally:
            random.setstate(python)
            np.random.set_state(array)


def close(env: EnvBase) -> None:
    """Close an environment, unless it is."""
    if not env.is_closed:
        env.close()


def bare(env: EnvBase) -> EnvBase:
    """The environment inside all transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env
