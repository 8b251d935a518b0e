"""What an environment may offer to the training, beyond TorchRL's own interface.

All of it is optional; all environments of ``tasks`` have it. Offers are looked for in the class of the
environment inside all transforms, not in the object: environments of processes look attributes up in their
workers.
"""

from __future__ import annotations

import numbers
import warnings
from typing import Any, Protocol, TypeVar, runtime_checkable

from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_sym.environments.inside import bare


class MakeEnv(Protocol):
    """Makes the training environment, e.g. ``functools.partial(tasks.make_env, "cartpole")``."""

    def __call__(self, *, num_envs: int, seed: int, **task: Any) -> EnvBase:
        """An environment of ``num_envs`` rows; the stages of a training may have arguments of their own."""
        ...


@runtime_checkable
class Staggered(Protocol):
    """Can start its first episodes at random times, so that batches hold all phases of an episode."""

    def stagger(self) -> None:
        """Start every row of the next full reset at a random time of its episode."""
        ...


@runtime_checkable
class Resumable(Protocol):
    """Can be saved and continued: what an exact resume needs."""

    def save_state(self) -> dict[str, Any]:
        """Everything that decides the future, as tensors, numbers and texts."""
        ...

    def restore_state(self, saved: dict[str, Any]) -> None:
        """Continue where :meth:`save_state` was called; the next full reset begins nothing anew."""
        ...


@runtime_checkable
class Measured(Protocol):
    """Measures what a return does not show: success rate, level of a curriculum."""

    def metrics(self) -> dict[str, float | Tensor]:
        """Figures since the last call, always under the same names.

        Tensors of one element, on an accelerator, are fetched with everything else; a number would have
        been waited for.
        """
        ...


@runtime_checkable
class Described(Protocol):
    """Says what decides its behaviour, so that a run is not continued in another environment."""

    def description(self) -> dict[str, Any]:
        """Name and arguments, as plain containers of numbers and texts."""
        ...


Offer = TypeVar("Offer")


def offered(env: EnvBase, offer: type[Offer]) -> Offer | None:
    """The environment inside all transforms, if its class has an offer."""
    base = bare(env)
    return base if issubclass(type(base), offer) else None  # pyright: ignore[reportReturnType]


def seed_unless_own(env: EnvBase, seed: int) -> None:
    """Seed an environment, whose maker may not have; those that save their state are trusted.

    With a maker that ignores its seed, no run could be repeated, and several seeds would mean nothing.
    """
    if offered(env, Resumable) is not None:
        return
    try:
        env.set_seed(seed)
    except NotImplementedError:
        warnings.warn(
            f"{type(bare(env)).__name__} cannot be seeded (set_seed is not implemented), so that this run "
            "cannot be repeated; implement _set_seed, or give make_env an environment that has it",
            UserWarning,
            stacklevel=4,
        )


def measure(env: EnvBase) -> dict[str, float | Tensor]:
    """What the environment measures, numbers or tensors of one element.

    Raises:
        TypeError: a value that is neither.
    """
    source = offered(env, Measured)
    if source is None:
        return {}
    metrics = source.metrics()
    for name, value in metrics.items():
        single = isinstance(value, Tensor) and value.numel() == 1
        if not single and not isinstance(value, numbers.Real):
            raise TypeError(
                f"expected a number for each of metrics() of {type(source).__name__}, got {value!r} for "
                f"{name!r}; convert it by float()"
            )
    return {
        name: value if isinstance(value, Tensor) else float(value)  # pyright: ignore[reportArgumentType]
        for name, value in metrics.items()
    }


def describe(env: EnvBase) -> dict[str, Any]:
    """What an environment is: its own description, or else its class and what it observes and takes."""
    source = offered(env, Described)
    if source is not None:
        return source.description()
    specs = {"observation": env.observation_spec, "action": env.full_action_spec}
    shapes = {
        f"{kind} {key}": [*spec.shape[env.batch_dims :]]
        for kind, group in specs.items()
        for key, spec in group.items(include_nested=True, leaves_only=True)
    }
    return {"environment": type(bare(env)).__name__, **shapes}
