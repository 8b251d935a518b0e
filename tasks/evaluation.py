"""Evaluation over equivalent goals: return, success and reward terms of each, and how much they differ.

The group maps the canonical goal onto every equivalent one, so an optimal policy earns the same on
all of them. The starts are paired: episode k of goal g is episode k of the canonical goal, mapped
by g. Then an exactly equivariant policy has exactly equal returns, and what `variation` shows is
the policy's asymmetry alone, not the luck of the draw. `variation` is the measure of the paper's
Table I. Physics that a task randomises is paired in the same way: see `tasks.paired_physics`.
"""

from __future__ import annotations

import contextlib
import operator
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from tasks.base import create
from tasks.environment import BatchedEnv
from tasks.paired_physics import draw_paired_physics


@dataclass(frozen=True)
class Evaluation:
    """What one evaluation measured: undiscounted returns, their terms, success.

    Attributes:
        goal_names: names of the N equivalent goals, one per group element.
        returns: ``(N, episodes)`` float64; column k is one draw, mapped by every element.
        successes: whether each episode reached its goal, ``(N, episodes)`` bool; None if the task has
            no such notion (:meth:`~tasks.base.Task.success`).
        terms: mean total per episode of every reward term by name, ``(N,)`` float64 each; they add up to
            the mean returns.
        task_terms: the terms that make up the task, as opposed to gait and effort; may be empty.
        behaviour: mean total per episode of what the robot did, ``(N,)`` float64 each, by name
            (:meth:`~tasks.base.Task.behaviour`); may be empty.

    Example:
        >>> import torch
        >>> result = Evaluation(("right", "left"), torch.tensor([[-1.0, -2.0], [-3.0, -4.0]]))
        >>> result.mean, result.variation
        (-2.5, 2.0)
    """

    goal_names: tuple[str, ...]
    returns: Tensor
    successes: Tensor | None = None
    terms: dict[str, Tensor] = field(default_factory=dict)
    task_terms: tuple[str, ...] = ()
    behaviour: dict[str, Tensor] = field(default_factory=dict)

    @property
    def goal_means(self) -> dict[str, float]:
        """Mean return of each goal."""
        return self._by_goal(self.returns.mean(dim=1))

    @property
    def mean(self) -> float:
        """Mean return over all goals."""
        return float(self.returns.mean())

    @property
    def variation(self) -> float:
        """Largest difference between the mean returns of two goals (the paper's Table I)."""
        means = self.returns.mean(dim=1)
        return float(means.max() - means.min())

    @property
    def goal_successes(self) -> dict[str, float]:
        """Success rate of each goal; empty if the task has no notion of success."""
        return {} if self.successes is None else self._by_goal(self.successes.double().mean(dim=1))

    @property
    def success(self) -> float | None:
        """Success rate over all goals; None if the task has no notion of success."""
        return None if self.successes is None else float(self.successes.double().mean())

    @property
    def task_means(self) -> dict[str, float]:
        """Mean return of each goal from ``task_terms`` alone; empty if the task does not name them."""
        if not self.task_terms:
            return {}
        return self._by_goal(torch.stack([self.terms[name] for name in self.task_terms]).sum(dim=0))

    @property
    def goal_behaviours(self) -> dict[str, dict[str, float]]:
        """Mean figures of behaviour of each goal: ``{goal: {name: mean}}``."""
        each = {name: self._by_goal(values) for name, values in self.behaviour.items()}
        return {goal: {name: values[goal] for name, values in each.items()} for goal in self.goal_names}

    def _by_goal(self, values: Tensor) -> dict[str, float]:
        return dict(zip(self.goal_names, values.tolist(), strict=True))


def evaluate(
    env: BatchedEnv | str,
    policy: Callable[[TensorDictBase], TensorDictBase],
    episodes: int = 500,
    seed: int = 0,
    *,
    num_threads: int = 2,
    exploration: ExplorationType = ExplorationType.DETERMINISTIC,  # pyright: ignore[reportArgumentType]
) -> Evaluation:
    """Run one episode per goal and start state, all at once.

    Success is judged at the last state of an episode; one whose simulation diverged has failed.
    A task that randomises its physics is evaluated with draws of it, the same for all goals of a start.

    Args:
        env: an environment, whose task is evaluated in simulations of its own (the environment
            itself is not touched), or a task's name.
        policy: writes ``"action"`` from ``"observation"``, for any batch size. Runs without
            gradients, in the mode (train, eval) it is in.
        episodes: episodes per goal.
        seed: seed of the start states, of randomised physics and of sampled actions; torch's global
            generators are put back.
        num_threads: physics threads.
        exploration: ``ExplorationType.RANDOM`` evaluates sampled actions. Starts are paired then too,
            the noise of the actions is not.

    Returns:
        Returns, successes and terms, per goal.

    Raises:
        TypeError: ``env`` is neither a :class:`BatchedEnv` nor a name, or an argument of a wrong type.
        ValueError: less than one episode, a negative number, or randomised physics that cannot be paired
            (:func:`~tasks.paired_physics.draw_paired_physics`).

    Example:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> still = TensorDictModule(lambda x: torch.zeros_like(x[..., :1]), ["observation"], ["action"])
        >>> result = evaluate("cartpole", still, episodes=4, num_threads=1)
        >>> result.goal_names, result.variation, result.success
        (('right', 'left'), 0.0, None)
    """
    if isinstance(env, str):
        task, where = create(env), {}
    elif isinstance(env, BatchedEnv):
        task, where = env.task, {"device": env.device, "engine": env.engine}
    else:
        raise TypeError(
            f"expected a BatchedEnv or a task name, got {type(env).__name__}; pass the base "
            "environment of a transformed one, and a policy that reads its plain observation"
        )
    if not callable(policy) or not isinstance(exploration, ExplorationType):
        raise TypeError(
            "expected a policy to call with a tensordict and an ExplorationType, got "
            f"{type(policy).__name__} and {exploration!r}"
        )
    episodes, seed = _whole("episodes", episodes, 1), _whole("seed", seed, 0)
    num_threads = _whole("num_threads", num_threads, 0)
    order = task.symmetry.group.order
    generator = torch.Generator().manual_seed(seed)
    starts = task.sample_goal_states(episodes, generator)
    batched = BatchedEnv(task, order * episodes, num_threads=num_threads, seed=seed, **where)
    # Streams of their own, so that neither moves the starts.
    noise_seed, physics_seed = torch.randint(2**31, (2,), generator=generator).tolist()
    draw_paired_physics(batched, physics_seed)
    with torch.no_grad(), set_exploration_type(exploration), _seeded(noise_seed):
        returns, successes, terms, behaviour = _run(batched, policy, batched.reset_to(starts))
    shape = (order, episodes)

    def by_goal(totals: dict[str, Tensor]) -> dict[str, Tensor]:
        return {name: x.reshape(shape).mean(dim=1).cpu() for name, x in totals.items()}

    return Evaluation(
        task.goal_names,
        returns.reshape(shape).cpu(),
        None if successes is None else successes.reshape(shape).cpu(),
        by_goal(terms),
        task.task_terms,
        by_goal(behaviour),
    )


def _whole(name: str, value: int, least: int) -> int:
    try:
        number = operator.index(value)
    except TypeError as error:
        raise TypeError(f"expected {name} to be a whole number, got {value!r}") from error
    if isinstance(value, bool) or number < least:
        raise ValueError(f"expected {name} of at least {least}, got {value!r}")
    return number


@contextlib.contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Torch's global generators at a seed of their own, and as they were afterwards."""
    devices = list(range(torch.cuda.device_count())) if torch.cuda.is_initialized() else []
    with torch.random.fork_rng(devices):
        torch.default_generator.manual_seed(seed)
        if devices:  # torch.manual_seed would reach devices that nothing restores
            torch.cuda.manual_seed_all(seed)
        yield


def _run(
    env: BatchedEnv,
    policy: Callable[[TensorDictBase], TensorDictBase],
    tensordict: TensorDictBase,
) -> tuple[Tensor, Tensor | None, dict[str, Tensor], dict[str, Tensor]]:
    """First episode of every row: return ``(n, 1)``, success, totals of terms and behaviour, ``(n,)``."""
    task = env.task
    running = ~tensordict["done"]
    returns = torch.zeros(running.shape, dtype=torch.float64, device=running.device)
    successes = task.success(env.state)  # every entry is replaced where its episode ends
    terms: dict[str, Tensor] = {}
    behaviour: dict[str, Tensor] = {}
    place = env.simulation.qpos.device  # of the physics and of what the task computes
    while bool(running.any()):
        before = env.state.variables
        tensordict = env.step(policy(tensordict))
        counted = running.squeeze(-1).to(place) & ~env.simulation.diverged()
        returns += tensordict["next", "reward"].double() * running
        ended = running & tensordict["next", "done"]
        state = env.state
        if successes is not None and bool(ended.any()):
            reached = task.success(state)
            assert reached is not None
            successes = torch.where(ended.squeeze(-1).to(place), reached & counted, successes)
        state.variables = before  # the reward sees the variables from before the step
        for totals, step in (
            (terms, task.reward_terms(state, tensordict["action"].to(place))),
            (behaviour, task.behaviour(state)),
        ):
            for name, value in step.items():
                totals[name] = totals.get(name, 0.0) + value.double().masked_fill(~counted, 0.0)
        running &= ~ended
        tensordict = step_mdp(tensordict)
    return returns, successes, terms, behaviour
