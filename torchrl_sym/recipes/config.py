"""Hyper-parameters of the PPO recipe, in one frozen dataclass."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import NestedKey

from torchrl_sym.checks import flag, key, one_of, real, sequence, whole


@dataclass(frozen=True)
class PPOConfig:
    """What to train with; every default is a value that quadruped and cart-pole PPO is run with.

    Raises:
        TypeError: a value of another type; the message names the field.
        ValueError: one outside its range.
    """

    augmentation: Literal["none", "all", "random", "naive"] = "all"
    """Symmetric copies: none (plain PPO); all of the orbit, or one random element per row, with the
    original log-probability (Eq. sym-aug); or naive, with log-probability and advantage re-evaluated."""
    mirror_coeff: float = 0.0
    """Weight w of the mirror loss (Eq. symm-loss), summed over group and action entries."""
    seed: int = 0
    """Seed of network weights, start states and exploration."""

    iterations: int = 400
    """Collect-and-learn rounds."""
    num_envs: int = 256
    """Parallel environments."""
    horizon: int = 32
    """Steps per environment and iteration."""
    epochs: int = 4
    """Passes over the data of an iteration."""
    minibatches: int = 8
    """Minibatches per pass. With 4, CartPole's slowest seeds had not swung up after 3 million steps."""

    gamma: float = 0.98
    """Discount; 0.98 is 1 s at 50 Hz. 0.99 was slower on CartPole."""
    lmbda: float = 0.95
    """GAE's lambda."""
    clip_epsilon: float = 0.2
    """Clip range of the probability ratio."""
    clip_value: float | None = 0.2
    """Clip range of the value's change, None for no clipping."""
    critic_coeff: float = 1.0
    """Weight of the (squared) value loss."""
    entropy_coeff: float = 0.02
    """Weight of the entropy bonus; at 0.005 CartPole's exploration dies before it swings up."""
    max_grad_norm: float = 1.0
    """Gradient norm over all parameters above which it is scaled down."""

    learning_rate: float = 1e-3
    """Adam's step size, at the start if it is adaptive."""
    desired_kl: float | None = 0.02
    """Policy change per update that the learning rate is adapted to (rsl_rl's rule: divided by 1.5
    above twice this value, multiplied by 1.5 below half of it). None keeps it constant. 0.01 and 0.005
    were slower on CartPole."""
    adapt_every: Literal["minibatch", "iteration"] = "minibatch"
    """When the learning rate is adapted: before the step of every minibatch, by its KL, as in rsl_rl; or
    after every iteration, by the KL of the last epoch."""
    min_learning_rate: float = 1e-5
    """Lower end of the adaptive learning rate."""
    max_learning_rate: float = 1e-2
    """Upper end of the adaptive learning rate."""

    network: Literal["mlp", "equivariant", "relaxed"] = "mlp"
    """Kind of actor and critic: ordinary; equivariant and invariant for any parameters, which needs no
    copies (``augmentation="none"``); or relaxed, equivariant when training begins and free to depart."""
    initialization: Literal["default", "symmetric"] = "default"
    """Initial weights of an ordinary network: PyTorch's, or their projection onto symmetric ones, scaled to
    the same norms."""
    relaxation_coeff: float = 1e-2
    """Price of departing: weight of the sum of squares of a relaxed network's free weights."""
    hidden: tuple[int, ...] = (32, 32)
    """Sizes of the hidden layers of actor and critic (ELU), rounded up to multiples of the group's order
    where they are copies of its regular representation (all but ordinary networks of default weights)."""
    initial_std: float = 1.0
    """Standard deviation of the policy at the start; it is learned, and does not depend on the state."""
    min_std: float = 0.05
    """Lower bound of the standard deviation."""
    max_std: float = 10.0
    """Upper bound of the standard deviation: clipped actions make a large one free of cost."""
    std_schedule: tuple[float, float] | None = None
    """Standard deviation in the first and in the last iteration, geometric in between: it is not learned
    then, and the initial one and its bounds have no effect. None: learned."""
    tie_std: bool = False
    """Give actions that the group exchanges (left and right knee) one standard deviation; without it, a
    policy is symmetric in its mean only. Equivariant networks always do."""
    weight_scale: float = 1.0
    """Factor on PyTorch's uniform initialisation of the actor (the paper's initialisation study)."""
    last_layer_scale: float = 1.0
    """Further factor on the actor's last layer; 0.1 is usual for legged robots."""

    output_scale: float = 1.0
    """Factor on the network's output: the size, in units of the action, of an ordinary action. Legged
    robots have a wide action box and work in a quarter of it."""

    normalize_observations: bool = False
    """Put a running normaliser that commutes with the group inside actor and critic, updated after every
    iteration. Off, since the tasks' observations are scaled by constants."""
    normalize_rewards: bool = False
    """Divide rewards by the standard deviation of the running discounted return."""
    actor_keys: tuple[NestedKey, ...] | None = None
    """Observations that the actor reads; the rest is for the critic, which is not there when a robot acts.
    None: all that the symmetry declares."""
    critic_keys: tuple[NestedKey, ...] | None = None
    """Observations that the critic reads. None: all that the symmetry declares."""

    max_log_ratio: float = 20.0
    """Bound of log pi / pi_k for naive augmentation, which overflows without; inf for none."""
    checkpoint_interval: int = 1
    """Iterations between checkpoints; the last one is always saved."""
    device: str = "cpu"
    """Where networks and updates live; physics is where the environment has it."""
    compile: bool = False
    """Compile the losses, where there is a compiler: about a minute before the first update. On ``"cuda"``,
    updates are also recorded into a CUDA graph, unless several processes share them."""
    autocast: Literal["bfloat16"] | None = None
    """Precision of the matrix products in the losses, None for that of the networks. Advantages, actions
    and the parameters keep theirs."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = _checked(field.name, str(field.type), getattr(self, field.name))
            object.__setattr__(self, field.name, value)
        if self.num_envs * self.horizon % self.minibatches:
            raise ValueError(
                f"minibatches: expected a divisor of num_envs * horizon = {self.num_envs * self.horizon}, "
                f"got {self.minibatches}"
            )
        for low, high in (("min_std", "max_std"), ("min_learning_rate", "max_learning_rate")):
            if getattr(self, low) > getattr(self, high):
                raise ValueError(
                    f"{low}: expected at most {high} = {getattr(self, high)}, got {getattr(self, low)}"
                )
        if self.network != "mlp" and self.initialization != "default":
            raise ValueError(
                f"initialization: expected 'default' for network={self.network!r}, which is symmetric when "
                f"training begins, got {self.initialization!r}"
            )
        if not self.min_std <= self.initial_std <= self.max_std:
            raise ValueError(
                f"initial_std: expected a number from min_std to max_std, [{self.min_std}, "
                f"{self.max_std}], got {self.initial_std}"
            )
        if 700 < self.max_log_ratio < math.inf:
            raise ValueError(
                "max_log_ratio: expected at most 700, whose exponential is a number, or inf for no bound, "
                f"got {self.max_log_ratio}"
            )

    @property
    def accelerated(self) -> bool:
        """Whether the host would wait for every number that it asks the networks' device for."""
        return torch.device(self.device).type != "cpu"

    def scheduled_std(self, iteration: int) -> float | None:
        """Standard deviation of an iteration, counted from 1; None if it is learned.

        Example:
            >>> [PPOConfig(iterations=3, std_schedule=(0.4, 0.1)).scheduled_std(i) for i in (1, 2, 3)]
            [0.4, 0.2, 0.1]
        """
        if self.std_schedule is None:
            return None
        first, last = self.std_schedule
        done = (iteration - 1) / max(1, self.iterations - 1)
        return first ** (1 - done) * last**done

    def differences(self, stored: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
        """Fields that differ from a stored configuration, as ``{name: (stored, mine)}``.

        Iterations, checkpoint interval, device and compilation may change when a run is continued;
        iterations only if no schedule depends on them. A field that was added after the configuration was
        stored counts as having had its default.
        """
        free = {"checkpoint_interval", "device", "compile"}
        if self.std_schedule is None or self.std_schedule[0] == self.std_schedule[1]:
            free.add("iterations")
        other = dataclasses.asdict(PPOConfig(**stored))
        return {
            name: (other[name], value)
            for name, value in dataclasses.asdict(self).items()
            if name not in free and other[name] != value
        }


_CHOICES = {
    "augmentation": ("none", "all", "random", "naive"),
    "adapt_every": ("minibatch", "iteration"),
    "network": ("mlp", "equivariant", "relaxed"),
    "initialization": ("default", "symmetric"),
    "autocast": ("bfloat16",),
}
_RANGES: dict[str, dict[str, float]] = {
    "gamma": {"low": 0, "high": 1},
    "lmbda": {"low": 0, "high": 1},
    "mirror_coeff": {"low": 0},
    "relaxation_coeff": {"low": 0},
    "critic_coeff": {"low": 0},
    "entropy_coeff": {"low": 0},
    "clip_epsilon": {"above": 0, "high": math.nextafter(1, 0)},
}
"""Which numbers a field takes, where it is not any positive one."""

_MAY_BE_INFINITE = {"max_grad_norm", "max_std", "max_log_ratio"}


def _checked(name: str, kind: str, value: Any) -> Any:
    """A field's value as a plain Python object, which a checkpoint can hold; NumPy's numbers are converted.

    Raises:
        TypeError: not of the field's type.
        ValueError: out of its range.
    """
    if value is None and kind.endswith("None"):
        return None
    if name in _CHOICES:
        return one_of(name, value, _CHOICES[name])
    if name == "device":
        return _device(value)
    if kind == "bool":
        return flag(name, value)
    if kind.startswith("tuple[NestedKey"):
        return _keys(name, value)
    if kind.startswith("tuple[int"):
        return tuple(whole(name, size, low=1) for size in sequence(name, value, "sizes"))
    if kind.startswith("tuple[float"):
        numbers = [real(name, each, above=0) for each in sequence(name, value, "two numbers")]
        if len(numbers) != 2:
            raise ValueError(f"{name}: expected two numbers, the first and the last, got {value!r}")
        return tuple(numbers)
    if kind == "int":
        return whole(name, value, 0, 2**63 - 1) if name == "seed" else whole(name, value, 1)
    if name in _MAY_BE_INFINITE and isinstance(value, float) and value == math.inf:
        return math.inf
    return real(name, value, **_RANGES.get(name, {"above": 0}))


def _keys(name: str, value: Any) -> tuple[NestedKey, ...]:
    """Keys, of which nested ones may be lists, as in a file of JSON."""
    keys = [
        key(name, tuple(each) if isinstance(each, list) else each) for each in sequence(name, value, "keys")
    ]
    if not keys:
        raise ValueError(f"{name}: expected at least one key, got none; None for all")
    if len(set(keys)) != len(keys):
        raise ValueError(f"{name}: expected distinct keys, got {value!r}")
    return tuple(keys)


def _device(value: Any) -> str:
    try:
        return str(torch.device(value))
    except (RuntimeError, TypeError) as error:
        raise ValueError(f"device: expected a device such as cpu or cuda:0, got {value!r}") from error
