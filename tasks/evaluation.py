"""Evaluation over equivalent goals: the return of each goal, and how much it differs between goals.

The group maps the canonical goal onto every equivalent one, so an optimal policy earns the same on
all of them. The starts are paired: episode k of goal g is episode k of the canonical goal, mapped
by g. Then an exactly equivariant policy has exactly equal returns, and what `variation` shows is
the policy's asymmetry alone, not the luck of the draw. `variation` is the measure of the paper's
Table I.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from tasks.base import create
from tasks.environment import BatchedEnv
from tasks.state import concatenate


@dataclass(frozen=True)
class Evaluation:
    """Undiscounted returns of one evaluation.

    Attributes:
        goal_names: names of the N equivalent goals, one per group element.
        returns: ``(N, episodes)`` float64; column k is one draw, mapped by every element.

    Example:
        >>> import torch
        >>> result = Evaluation(("right", "left"), torch.tensor([[-1.0, -2.0], [-3.0, -4.0]]))
        >>> result.mean, result.variation
        (-2.5, 2.0)
    """

    goal_names: tuple[str, ...]
    returns: Tensor

    @property
    def goal_means(self) -> dict[str, float]:
        """Mean return of each goal."""
        return dict(zip(self.goal_names, self.returns.mean(dim=1).tolist(), strict=True))

    @property
    def mean(self) -> float:
        """Mean return over all goals."""
        return float(self.returns.mean())

    @property
    def variation(self) -> float:
        """Largest difference between the mean returns of two goals (the paper's Table I)."""
        means = self.returns.mean(dim=1)
        return float(means.max() - means.min())


def evaluate(
    env: BatchedEnv | str,
    policy: Callable[[TensorDictBase], TensorDictBase],
    episodes: int = 500,
    seed: int = 0,
    *,
    num_threads: int = 2,
) -> Evaluation:
    """Run one deterministic episode per goal and start state, all at once.

    Args:
        env: an environment, whose task is evaluated in simulations of its own (the environment
            itself is not touched), or a task's name.
        policy: writes ``"action"`` from ``"observation"``, for any batch size. Runs with
            ``ExplorationType.DETERMINISTIC``, without gradients, in the mode (train, eval) it is
            in.
        episodes: episodes per goal.
        seed: seed of the start states.
        num_threads: physics threads.

    Returns:
        The returns per goal and episode.

    Raises:
        TypeError: ``env`` is neither a :class:`BatchedEnv` nor a name.

    Example:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> still = TensorDictModule(lambda x: torch.zeros_like(x[..., :1]), ["observation"], ["action"])
        >>> result = evaluate("cartpole", still, episodes=4, num_threads=1)
        >>> result.goal_names, result.variation
        (('right', 'left'), 0.0)
    """
    if isinstance(env, str):
        task, device = create(env), None
    elif isinstance(env, BatchedEnv):
        task, device = env.task, env.device
    else:
        raise TypeError(
            f"expected a BatchedEnv or a task name, got {type(env).__name__}; pass the base "
            "environment of a transformed one, and a policy that reads its plain observation"
        )
    order = task.symmetry.group.order
    canonical = task.sample_goal_state(episodes, torch.Generator().manual_seed(seed))
    starts = [task.transform_state(canonical, g) for g in range(order)]
    batched = BatchedEnv(task, order * episodes, num_threads=num_threads, seed=seed, device=device)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        returns = _run(batched, policy, batched.reset_to(concatenate(starts)))
    return Evaluation(task.goal_names, returns.reshape(order, episodes).cpu())


def _run(
    env: BatchedEnv,
    policy: Callable[[TensorDictBase], TensorDictBase],
    tensordict: TensorDictBase,
) -> Tensor:
    """Return of the first episode of every row, ``(n, 1)`` float64."""
    running = ~tensordict["done"]
    returns = torch.zeros(running.shape, dtype=torch.float64, device=running.device)
    while bool(running.any()):
        tensordict = env.step(policy(tensordict))
        returns += tensordict["next", "reward"].double() * running
        running &= ~tensordict["next", "done"]
        tensordict = step_mdp(tensordict)
    return returns
