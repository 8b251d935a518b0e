"""With which hyper-parameters each task learns: one frozen configuration per task.

Numbers that are not explained here are those of `PPOConfig`, or of legged_gym for the legged robot
(24 steps, 5 epochs of 4 minibatches, gamma 0.99, three layers of 128, value clipping).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

from torchrl_sym.recipes import PPOConfig, Stage


@dataclass(frozen=True)
class Setting:
    """How a task is trained.

    Attributes:
        config: hyper-parameters of the first stage.
        task: arguments of the task in the first stage.
        evaluations: arguments of the task in evaluation, by what is evaluated.
        then: further stages, each from the last state of the one before it.
        tuned: changes of the hyper-parameters by family of methods, where each was tuned by itself: plain
            PPO (``"ppo"``), augmentation (``"aug"``), mirror loss (``"loss"``), naive augmentation
            (``"aug-naive"``), equivariant networks (``"equivariant"``) and relaxed ones (``"relaxed"``).
    """

    config: PPOConfig
    task: dict[str, Any] = field(default_factory=dict)
    evaluations: dict[str, dict[str, Any]] = field(default_factory=lambda: {"task": {}})
    then: tuple[Stage, ...] = ()
    tuned: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def stages(self) -> tuple[Stage, ...]:
        """All stages in order, for :func:`torchrl_sym.recipes.train_stages`."""
        return (Stage(self.config, self.task), *self.then)

    @property
    def frames(self) -> int:
        """Environment steps of all stages."""
        configs = [stage.config for stage in self.stages]
        return sum(c.iterations * c.num_envs * c.horizon for c in configs)

    def replace(self, **changes: Any) -> Setting:
        """The same with other hyper-parameters, in every stage.

        Example:
            >>> SETTINGS["anymal_push"].replace(seed=1).then[0].config.seed
            1
        """
        first, *later = (
            dataclasses.replace(stage, config=dataclasses.replace(stage.config, **changes))
            for stage in self.stages
        )
        return dataclasses.replace(self, config=first.config, then=tuple(later))

    def tuned_for(self, family: str) -> Setting:
        """The same with what was tuned for a family of methods, if anything was."""
        return self.replace(**self.tuned.get(family, {}))


# An action of 1 moves a target by 2 rad, a walking robot's by some 0.5 rad: networks put out quarters, and
# the noise starts at 0.3 rad. The cap of the learning rate is lower than legged_gym's 1e-2: batches are an
# eighth of its. All copies: one random element per sample costs a quarter of them and learns less
# (docs/results.md).
# (With 1024 simulations, half as many updates per step, pushing took twice the steps; a KL of 0.012 was
# slower, 0.03 fell over at once.)
_ANYMAL = PPOConfig(
    augmentation="all",
    num_envs=512,
    horizon=24,
    epochs=5,
    minibatches=4,
    gamma=0.99,
    entropy_coeff=0.0005,
    desired_kl=0.02,
    adapt_every="iteration",
    max_learning_rate=2e-3,
    hidden=(128, 128, 128),
    initial_std=0.15,
    max_std=0.5,
    last_layer_scale=0.1,
    output_scale=0.25,
    checkpoint_interval=20,
)
# Policies lean on their noise, which starts steps: mean actions come to a stop before the target. With less
# of it for the last steps they lean less, and do as well in steps of 0.005 s as in those of training. It is
# the same for all methods: a learned deviation would be left wherever each of them had it.
_STEADY = {"desired_kl": 0.015, "entropy_coeff": 0.0, "std_schedule": (0.08, 0.08)}
# Training in steps of 0.01 s is 1.4 times as fast.
_FAST = {"physics_timestep": 0.01}

_PUSH = dataclasses.replace(_ANYMAL, iterations=400)  # 4.9 M steps
_PUSH_ON = dataclasses.replace(_PUSH, iterations=60, **_STEADY)  # 0.7 M
_CLIMB = dataclasses.replace(_ANYMAL, iterations=600)  # 7.4 M
_CLIMB_ON = dataclasses.replace(_CLIMB, iterations=100, **_STEADY)  # 1.2 M

# Nine torques: noise has to move fingers, hence the large deviation.
_REPOSE = PPOConfig(
    augmentation="all",
    iterations=500,  # 4.1 M steps
    num_envs=512,
    horizon=16,
    epochs=3,
    minibatches=4,
    gamma=0.99,
    clip_value=None,
    entropy_coeff=0.001,
    desired_kl=0.02,
    max_learning_rate=4e-3,
    hidden=(128, 128),
    initial_std=0.6,
    max_std=1.0,
    last_layer_scale=0.1,
    checkpoint_interval=20,
)
# Less noise for the last 1.2 M steps: mean actions, which are what is evaluated, fell behind sampled ones.
_REPOSE_ON = dataclasses.replace(
    _REPOSE, iterations=150, desired_kl=0.015, entropy_coeff=0.0, std_schedule=(0.1, 0.1)
)

# Twice the recipe's default of simulations: two thirds of the time per step, since every call of TorchRL or
# of the networks has a constant cost, and no worse per step (3 seeds each, with and without copies). With
# 1024 x 16 it is another seventh faster, but plain PPO learned less. `tuned` below is what
# `python benchmarks/tune.py` chose for each family of methods, out of the same candidates and with as many
# runs each (results/tuning, results/tuning-networks).
_CARTPOLE = PPOConfig(
    iterations=202,  # 3.3 M steps
    num_envs=512,
    horizon=32,
    checkpoint_interval=10,
)

SETTINGS: dict[str, Setting] = {
    "cartpole": Setting(
        _CARTPOLE,
        tuned={
            "ppo": {"desired_kl": 0.02, "minibatches": 8},
            "aug": {"desired_kl": 0.02, "minibatches": 8},
            "loss": {"desired_kl": 0.02, "minibatches": 8},
            "aug-naive": {"desired_kl": 0.02, "gamma": 0.99, "minibatches": 8},
            "equivariant": {"desired_kl": 0.02, "minibatches": 4},
            "relaxed": {"desired_kl": 0.02, "minibatches": 4},
        },
    ),
    "anymal_push": Setting(_PUSH, _FAST, then=(Stage(_PUSH_ON, _FAST),)),
    "anymal_climb": Setting(
        _CLIMB,
        _FAST,
        {"facing the box": {"phase": "B"}, "any heading": {"phase": "C"}},
        # Last in steps of 0.005 s, in which contacts at the edge differ, and on the highest box alone.
        then=(Stage(_CLIMB_ON, {"phase": "C", "curriculum": False}),),
    ),
    "trifinger_repose": Setting(
        _REPOSE,
        _FAST,
        {"difficulty 1": {"difficulty": 1}},
        then=(Stage(_REPOSE_ON, _FAST | {"curriculum": False}),),  # the whole disc, as in evaluation
    ),
}
"""Settings by task name."""
