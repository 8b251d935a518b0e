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

# The study of networks and of asymmetry. What is trained without a dose is evaluated with all of them.
COMPARED = ("ppo", "aug", "loss-0.1", "equivariant", "relaxed")
_CARTPOLE_DOSES = tuple(
    f"{knob}={dose:g}"
    for knob, doses in {
        "motor_bias": (0.5, 1.0, 1.5, 2.0),  # m/s, of 3 that the motor does
        "rail_tilt": (2, 5, 10, 15),  # degrees
        "wind": (0.25, 0.5, 1, 2),  # m/s
    }.items()
    for dose in doses
)
_PUSH_DOSES = ("payload=10.0,payload_position=(0.2,0.1,0.1)", "weak_leg=LF")  # of a robot of some 50 kg


def _doses(task: str, doses: Sequence[str], methods: Sequence[str], seeds: int) -> Experiment:
    """A task with one asymmetry at a time, in training and in evaluation."""
    return Experiment(tuple(f"{task}@{dose}" for dose in doses), tuple(methods), seeds)


def _with_networks(task: str, seeds: int, weight: str, under: Sequence[str] = ()) -> Experiment:
    """All ways to a symmetric policy, with the best weight of the mirror loss."""
    methods = ("ppo", "aug", "aug-random", f"loss-{weight}", f"aug+loss-{weight}", "equivariant", "relaxed")
    return Experiment((task,), methods, seeds, under=tuple(under))


_STUDY_CARTPOLE = (
    _with_networks("cartpole", 20, "0.1"),
    Experiment(("cartpole",), ("aug+init-4", "aug+symmetric-init", "aug+symmetric-init+init-4"), 10),
    Experiment(("cartpole",), COMPARED, 10, under=_CARTPOLE_DOSES),
)

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
    "study-cartpole": _STUDY_CARTPOLE,
    "study-cartpole-doses": (_doses("cartpole", _CARTPOLE_DOSES, COMPARED, 10),),
    "study-push": (_with_networks("anymal_push", 5, "10", _PUSH_DOSES),),
    "study-push-doses": (_doses("anymal_push", _PUSH_DOSES, ("ppo", "aug", "equivariant", "relaxed"), 3),),
    "study-repose": (_with_networks("trifinger_repose", 5, "10"),),
    "study-repose-yaw": (
        Experiment(("repose_yaw:make_env",), ("ppo", "aug", "equivariant", "relaxed"), 5),
    ),
    "study-climb": (_with_networks("anymal_climb", 3, "1"),),
    "paper": (_CARTPOLE, *_MORE_SEEDS, *_PUSH, *_CLIMB, *_REPOSE, *_REPOSE_YAW),
}
