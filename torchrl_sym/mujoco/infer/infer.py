"""Infer how observations and actions transform, from the simulator itself.

`derive` knows the image L_g s of every state s of a model. What an environment makes of a state is its
own affair: a subset of joints, a torso's frame, forces on feet, last actions. So it is asked: observe s,
observe L_g s, and solve obs(L_g s) = rho(g) obs(s) for rho, over many states. Nothing is declared by hand.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup, check_group
from torchrl_sym.mujoco.infer.actions import ActionFinder
from torchrl_sym.mujoco.infer.errors import InferenceError
from torchrl_sym.mujoco.infer.inferred import InferredSymmetry
from torchrl_sym.mujoco.infer.observations import ObservationFinder
from torchrl_sym.mujoco.infer.refusal import notes_on, ranges, refuse
from torchrl_sym.mujoco.infer.samples import Sampler
from torchrl_sym.mujoco.verify.recognition import subject_of
from torchrl_sym.mujoco.verify.remembered import Remembered, remembered
from torchrl_sym.mujoco.verify.subjects import Pose
from torchrl_sym.representations import Representation

MOST = 100_000  # samples


def infer(
    env: Any,
    group: PointGroup,
    *,
    keyframe: int | str | None = None,
    axis: tuple[float, float] | None = None,
    carried: Sequence[str] = (),
    memory: Mapping[str, Representation] | Remembered | None = None,
    observe: Callable[[Any], Any] | None = None,
    samples: int = 96,
    seed: int = 0,
    tolerance: float = 1e-4,
) -> InferredSymmetry:
    """How an environment's observation and action transform under a group.

    The simulator is put into random states s and their images L_g s (:func:`~torchrl_sym.mujoco.derive`
    knows them), both are observed, and the representation of every key is solved for: signed permutations,
    orthogonal mixtures where entries are turned, constants to themselves. Episodes of mirrored actions
    reach what an environment remembers beside MuJoCo's state, such as last actions and histories, also in
    wrappers. Contact forces are exercised by random additions to them. A third of the states is held out,
    and the result is checked on them.

    Args:
        env: a gymnasium environment around MuJoCo (with wrappers, also of goals), a dm_control
            ``Environment``, TorchRL's ``GymEnv`` or ``DMControlEnv`` around them, or one of our batched
            tasks. It is reset, seeded and stepped.
        group: which symmetry.
        keyframe: symmetric pose for ``derive``, which finds one by default.
        axis: point (x, y) of the vertical axis that the group acts about, for ``derive``, which finds it by
            default.
        carried: bodies that a turn of the world only carries along, for ``derive``.
        memory: what episodes of mirrored actions do not reach, such as a command or a target that is drawn
            at a reset: attributes with their representations, or :class:`~torchrl_sym.mujoco.Remembered`.
        observe: applied to every observation first: to drop entries, for example.
        samples: number of states.
        seed: seed of states and actions.
        tolerance: largest difference between an entry and its image that counts as none, relative to the
            entry; for models that are symmetric only approximately, raise it.

    Returns:
        A symmetry of all keys, as TorchRL names them, and ``"action"``. ``print`` lists it, with notes on
        entries that never changed or that always agree; ``code()`` is the declaration, to be reviewed.

    Raises:
        InferenceError: an entry has no image; one state is observed in two ways; too little happened to
            tell; or an element changes nothing. The message names entries and the remedy.
        SymmetryError: the model does not have the group.
        TypeError: an environment of another kind.
        ValueError: an argument out of its range.

    Example:
        >>> from dm_control import suite
        >>> symmetry = infer(suite.load("cartpole", "swingup"), PointGroup.reflection("x"))
        >>> symmetry["position"](torch.tensor([1.0, 2.0, 3.0]), "reflect-x")
        tensor([-1.,  2., -3.])
    """
    check_group(group)
    kept = remembered(memory)
    if kept is not None:
        kept.check_group(group)
    samples, seed = checks.whole("samples", samples, 12, MOST), checks.whole("seed", seed, 0, 2**32 - 1)
    tolerance = checks.real("tolerance", tolerance, 0.0)
    if observe is not None:
        checks.function("observe", observe)

    subject = subject_of(env, group, observe, Pose(keyframe, axis, carried), seed, kept)
    generator = torch.Generator().manual_seed(seed)
    actions = ActionFinder(subject, group, generator)
    action = actions.find()
    observations = ObservationFinder(Sampler(subject, action, generator), group, tolerance)
    observations.find(samples)
    refuse(observations)
    found = {**observations.representations(), "action": action}
    _check_faithful(group, found.values())

    notes = notes_on(observations)
    if actions.still:
        notes.append(f"action {ranges(actions.still)} moves nothing that was tried: stays as it is")
    labels = {**observations.labels, "action": actions.labels()}
    return InferredSymmetry(group, found, labels, notes)


def _check_faithful(group: PointGroup, found: Any) -> None:
    """InferenceError if an element changes nothing: its copies would be the originals."""
    found = list(found)
    idle = [
        name
        for g, name in enumerate(group.names)
        if g and all(r.restrict(group.subgroup([g])).is_trivial for r in found)
    ]
    if idle:
        raise InferenceError(
            f"{', '.join(idle)} changes no entry of the observation or the action, so that copies would be "
            "the samples themselves: a robot that moves in this plane only, or nothing that tells the "
            "sides apart is observed; take a group without it"
        )
