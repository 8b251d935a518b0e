"""With which hyper-parameters each task learns: one frozen configuration per task.

Numbers that are not explained here are those of `PPOConfig`, or of legged_gym for the legged robot
(24 steps, 5 epochs of 4 minibatches, gamma 0.99, three layers of 128, value clipping).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

from torchrl_sym.recipes import PPOConfig


@dataclass(frozen=True)
class Setting:
    """How a task is trained.

    Attributes:
        config: hyper-parameters of :func:`torchrl_sym.recipes.train`.
        task: arguments of the task in training.
        evaluations: arguments of the task in evaluation, by what is evaluated.
    """

    config: PPOConfig
    task: dict[str, Any] = field(default_factory=dict)
    evaluations: dict[str, dict[str, Any]] = field(default_factory=lambda: {"task": {}})


# An action of 1 moves a target by 2 rad, a walking robot's by some 0.5 rad: networks put out quarters, and
# the noise starts at 0.4 rad. The learning rate may not rise to 1e-2: the noise then dies before the first
# steps are found. One random element per sample costs a quarter of the orbit and learns as well per sample.
_ANYMAL = PPOConfig(
    augmentation="random",
    num_envs=512,
    horizon=24,
    epochs=5,
    minibatches=4,
    gamma=0.99,
    entropy_coeff=0.003,
    desired_kl=0.02,
    max_learning_rate=2e-3,
    hidden=(128, 128, 128),
    initial_std=0.2,
    max_std=0.5,
    last_layer_scale=0.1,
    output_scale=0.25,
    checkpoint_interval=20,
)
# Training in steps of 0.01 s is 1.4 times as fast; policies do as well in steps of 0.005 s.
_FAST = {"physics_timestep": 0.01}

SETTINGS: dict[str, Setting] = {
    "cartpole": Setting(PPOConfig()),
    "anymal_push": Setting(dataclasses.replace(_ANYMAL, iterations=976), _FAST),  # 12.0 M steps
    "anymal_climb": Setting(  # 40.0 M steps
        dataclasses.replace(_ANYMAL, iterations=3255),
        _FAST,
        {"facing the box": {"phase": "B"}, "any heading": {"phase": "C"}},
    ),
}
"""Settings by task name."""
