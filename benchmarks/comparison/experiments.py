"""Which methods are compared on which tasks: the experiments of the paper, by name."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

MAIN = ("ppo", "aug", "aug-random", "loss-0.1", "loss-1", "loss-10", "aug+loss-0.1")
SCALES = ("aug+init-0.1", "aug+init-4", "aug+loss-0.1+init-4")
ALL = (*MAIN, "aug-naive", "aug-naive-raw", *SCALES)


@dataclass(frozen=True)
class Experiment:
    """Some methods on some tasks.

    Attributes:
        tasks: names, see `environments.py`.
        methods: see `methods.py`.
        seeds: how many, from 0.
        steps: environment steps; None for what the task's settings say.
        config: changes of the configuration.
        episodes: evaluation episodes per goal.
        under: arguments of the task with which it is evaluated in addition, such as `motor_bias=0.5`.
    """

    tasks: tuple[str, ...]
    methods: tuple[str, ...]
    seeds: int
    steps: int | None = None
    config: dict[str, Any] = field(default_factory=dict)
    episodes: int = 500
    under: tuple[str, ...] = ()


OWN = Experiment(("cartpole",), ("ppo", "aug"), 5)  # what a command line changes
_TINY = {"num_envs": 32, "horizon": 50, "epochs": 1, "minibatches": 2}
_CARTPOLE = Experiment(("cartpole",), ALL, 10)
_MORE_SEEDS = (
    Experiment(("cartpole",), ("ppo", "aug", "aug+init-0.1"), 20),  # which is faster, and better?
    Experiment(("cartpole",), ("aug+loss-0.1+init-0.1",), 10),
)


def _robot(task: str, seeds: int, weights: Sequence[str], others: Sequence[str]) -> tuple[Experiment, ...]:
    """Weights of the mirror loss with all seeds, that whose first seed did best first; others with one."""
    methods = ("ppo", "aug", "aug-random", *(f"loss-{w}" for w in weights), f"aug+loss-{weights[0]}")
    return Experiment((task,), methods, seeds), Experiment((task,), tuple(f"loss-{w}" for w in others), 1)


_PUSH = _robot("anymal_push", 5, ("10",), ("1", "100"))
_CLIMB = _robot("anymal_climb", 3, ("1", "0.1"), ("10",))  # the first seeds of both came within 0.1
_REPOSE = _robot("trifinger_repose", 3, ("10",), ("0.1", "1", "100"))
_REPOSE_YAW = (Experiment(("repose_yaw:make_env",), ("ppo", "aug"), 3),)

PRESETS: dict[str, tuple[Experiment, ...]] = {
    "smoke": (
        Experiment(("cartpole",), ALL, 1, 32 * 50 * 12, _TINY, 4),
        Experiment(("cartpole",), ("ppo", "aug"), 2, 32 * 50 * 12, _TINY, 4),
        Experiment(("anymal_push", "anymal_climb", "trifinger_repose"), ("ppo", "aug"), 1, 3200, _TINY, 4),
    ),
    "paper-cartpole": (_CARTPOLE,),
    "paper-cartpole-20": (_CARTPOLE, *_MORE_SEEDS),
    "paper-push": _PUSH,
    "paper-climb": _CLIMB,
    "paper-repose": _REPOSE,
    "paper-repose-yaw": _REPOSE_YAW,
    "paper": (_CARTPOLE, *_MORE_SEEDS, *_PUSH, *_CLIMB, *_REPOSE, *_REPOSE_YAW),
}
