"""Training in stages: each goes on from the one before, with other hyper-parameters or in another task."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchrl_sym.recipes.config import PPOConfig
from torchrl_sym.recipes.environment import MakeEnv
from torchrl_sym.recipes.training import Training, train
from torchrl_sym.symmetry import Symmetry


@dataclass(frozen=True)
class Stage:
    """One stage of a training.

    Attributes:
        config: hyper-parameters.
        task: arguments of the environment in this stage, beside ``num_envs`` and ``seed``.
    """

    config: PPOConfig
    task: dict[str, Any] = field(default_factory=dict)


def train_stages(
    stages: Sequence[Stage],
    make_env: MakeEnv,
    symmetry: Symmetry,
    *,
    folder: str | os.PathLike,
    logger: str | None = "csv",
    progress: bool = False,
) -> Training:
    """Prepare a training in stages; it yields what :func:`train` yields, and the number of the ``stage``.

    Each stage has a folder of its own, ``stage_0``, ``stage_1``, ... and begins with the networks,
    optimizer, running episodes and curriculum of the one before. Killed at any time and called again, it
    continues; finished stages are not repeated. :func:`load_actor` takes the folder of them all.

    Args:
        stages: what to train with, in order; networks and number of environments must be the same.
        make_env: called with ``num_envs``, ``seed`` and the stage's own arguments.
        symmetry: what transforms how, in every stage.
        folder: where the stages' folders go.
        logger: as in :func:`train`.
        progress: show a progress bar per stage.

    Raises:
        ValueError: no stage, or stages that cannot follow each other.

    Example:
        >>> import dataclasses, functools, tasks, tempfile
        >>> from torchrl_sym.recipes import PPOConfig, Stage, train_stages
        >>> make_env = functools.partial(tasks.make_env, "cartpole", num_threads=1)
        >>> config = PPOConfig(iterations=2, num_envs=8, horizon=8)
        >>> steady = dataclasses.replace(config, iterations=1, std_schedule=(0.1, 0.1))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     rows = train_stages(
        ...         [Stage(config), Stage(steady)], make_env, make_env(num_envs=1).symmetry, folder=folder
        ...     )
        ...     [(row["stage"], row["iteration"], round(row["std"], 3)) for row in rows]
        [(0, 1, 1.0), (0, 2, 0.985), (1, 1, 0.1)]
    """
    stages = tuple(stages)
    _check(stages)
    makers = [functools.partial(make_env, **stage.task) for stage in stages]
    for make in makers[1:]:  # better now than after the first stage
        env = make(num_envs=1, seed=0)
        symmetry.check_specs(env)
        env.close()

    folders = [Path(folder) / f"stage_{number}" for number in range(len(stages))]
    runs = [
        functools.partial(
            train,
            stage.config,
            make,
            symmetry,
            folder=own,
            start_from=earlier,
            logger=logger,
            progress=progress,
        )
        for stage, make, own, earlier in zip(stages, makers, folders, [None, *folders], strict=False)
    ]
    first = runs[0]()
    return Training(_rows(first, runs[1:]), first.close)


def _rows(first: Training, later: Sequence[Callable[[], Training]]) -> Generator[dict[str, float]]:
    for metrics in first:
        yield {"stage": 0, **metrics}
    for number, begin in enumerate(later, 1):
        for metrics in begin():
            yield {"stage": number, **metrics}


def _check(stages: Sequence[Stage]) -> None:
    """What must not differ between stages, better said before the first than before the second."""
    if not stages or not all(isinstance(stage, Stage) for stage in stages):
        raise ValueError(f"expected a sequence of at least one Stage, got {stages!r}")
    inputs = ("normalize_observations", "normalize_rewards", "actor_keys", "critic_keys")
    for name in ("num_envs", "hidden", "tie_std", "output_scale", "seed", *inputs):
        values = [getattr(stage.config, name) for stage in stages]
        if any(value != values[0] for value in values):
            raise ValueError(f"{name}: expected the same in all stages, got {values}")
