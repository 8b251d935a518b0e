"""Hyper-parameters of the PPO recipe, in one frozen dataclass."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class PPOConfig:
    """What to train with; every default is a value that quadruped and cart-pole PPO is run with.

    Raises:
        ValueError: a number outside its range; the message names the field.
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
    minibatches: int = 4
    """Minibatches per pass."""

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
    desired_kl: float | None = 0.01
    """Policy change per update that the learning rate is adapted to (rsl_rl's rule: divided by 1.5
    above twice this value, multiplied by 1.5 below half of it). None keeps it constant."""
    adapt_every: Literal["minibatch", "iteration"] = "minibatch"
    """How often the learning rate is adapted. After every minibatch, as in rsl_rl, it climbs by 1.5 per
    minibatch as long as the policy is near the one that collected the data, and falls as fast afterwards:
    with 20 minibatches most steps are tiny and a few are far too large. After every iteration (by the KL
    of the last epoch) it settles."""
    min_learning_rate: float = 1e-5
    """Lower end of the adaptive learning rate."""
    max_learning_rate: float = 1e-2
    """Upper end of the adaptive learning rate."""

    hidden: tuple[int, ...] = (32, 32)
    """Sizes of the hidden layers of actor and critic (ELU)."""
    initial_std: float = 1.0
    """Standard deviation of the policy at the start; it is learned, and does not depend on the state."""
    min_std: float = 0.05
    """Lower bound of the standard deviation."""
    max_std: float = 10.0
    """Upper bound of the standard deviation: clipped actions make a large one free of cost."""
    tie_std: bool = False
    """Give actions that the group exchanges (left and right knee) one standard deviation; without it, a
    policy is symmetric in its mean only."""
    weight_scale: float = 1.0
    """Factor on PyTorch's uniform initialisation of the actor (the paper's initialisation study)."""
    last_layer_scale: float = 1.0
    """Further factor on the actor's last layer; 0.1 is usual for legged robots."""

    output_scale: float = 1.0
    """Factor on the network's output: the size, in units of the action, of an ordinary action. Legged
    robots have a wide action box and work in a quarter of it."""

    max_log_ratio: float = 20.0
    """Bound of log pi / pi_k for naive augmentation, which overflows without; inf for none."""
    checkpoint_interval: int = 1
    """Iterations between checkpoints; the last one is always saved."""
    device: str = "cpu"
    """Where networks and updates live; physics stays on the CPU."""

    def __post_init__(self) -> None:
        choices = ("none", "all", "random", "naive")
        if self.augmentation not in choices:
            raise ValueError(f"augmentation: expected one of {choices}, got {self.augmentation!r}")
        if self.adapt_every not in ("minibatch", "iteration"):
            raise ValueError(f"adapt_every: expected minibatch or iteration, got {self.adapt_every!r}")
        counts = ("iterations", "num_envs", "horizon", "epochs", "minibatches", "checkpoint_interval")
        for name in counts:
            value = getattr(self, name)
            if value < 1 or int(value) != value:
                raise ValueError(f"{name}: expected a whole number of at least 1, got {value}")
        if not all(size >= 1 for size in self.hidden):
            raise ValueError(f"hidden: expected positive sizes, got {self.hidden}")
        positive = (
            "learning_rate",
            "max_grad_norm",
            "initial_std",
            "min_std",
            "max_std",
            "clip_epsilon",
            "output_scale",
            "max_log_ratio",
        )
        for name in positive:
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a positive number, got {getattr(self, name)}")
        if 700 < self.max_log_ratio < math.inf:
            raise ValueError(
                "max_log_ratio: expected at most 700, whose exponential is a number, or inf for no bound, "
                f"got {self.max_log_ratio}"
            )
        for name in ("gamma", "lmbda"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: expected a number in [0, 1], got {getattr(self, name)}")
        for name in ("mirror_coeff", "entropy_coeff", "critic_coeff"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: expected a number >= 0, got {getattr(self, name)}")
        if self.num_envs * self.horizon % self.minibatches:
            raise ValueError(
                f"minibatches: expected a divisor of num_envs * horizon = {self.num_envs * self.horizon}, "
                f"got {self.minibatches}"
            )

    def differences(self, other: dict) -> dict[str, tuple]:
        """Fields that differ from a stored configuration, as ``{name: (stored, mine)}``.

        Iterations, checkpoint interval and device may change when a run is continued. A field that was
        added after the configuration was stored counts as having had its default.
        """
        mine = dataclasses.asdict(self)
        free = {"iterations", "checkpoint_interval", "device"}
        other = {field.name: field.default for field in dataclasses.fields(self)} | other
        return {
            name: (other.get(name), value)
            for name, value in mine.items()
            if name not in free and _plain(other.get(name)) != _plain(value)
        }


def _plain(value):
    return list(value) if isinstance(value, tuple) else value
