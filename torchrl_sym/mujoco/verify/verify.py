"""Verify a symmetry on an environment: does the simulation agree with the signs somebody wrote down?

For each element g, with L_g and K_g of the paper, a symmetric task satisfies::

    obs(L_g s) = L_g obs(s),   T(L_g s, K_g a) = L_g T(s, a),   r(L_g s, K_g a) = r(s, a)

and its starts are distributed symmetrically. `verify` measures all of it at states that the environment
reaches, and says which part is wrong, and where: an entry of an observation, a joint, the reward.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from torchrl_sym import checks
from torchrl_sym.mujoco.verify.measurement import Measurement
from torchrl_sym.mujoco.verify.recognition import subject_of
from torchrl_sym.mujoco.verify.remembered import Remembered, remembered
from torchrl_sym.mujoco.verify.report import PARTS, VerifyReport
from torchrl_sym.mujoco.verify.subjects import Pose
from torchrl_sym.representations import Representation
from torchrl_sym.symmetry import Symmetry, check_symmetry

MAX_WARM_UP = 50  # random actions before a state is tested
MOST = 100_000  # states, or steps: more would take days
CONTACTS = 4  # states in contact that are added, if there were none


def verify(
    env: Any,
    symmetry: Symmetry,
    *,
    keyframe: int | str | None = None,
    axis: tuple[float, float] | None = None,
    carried: Sequence[str] = (),
    states: int = 16,
    steps: int = 10,
    tolerance: float = 1e-8,
    seed: int = 0,
    observe: Callable[[Any], Any] | None = None,
    memory: Mapping[str, Representation] | Remembered | None = None,
) -> VerifyReport:
    """Measure how far an environment is from the symmetry declared for it.

    The states are reached from resets by up to 50 random actions. From each of them and from its images
    the environment is stepped with random actions and their images. The identity is tested too: it fails
    if something that decides the future is not part of the state, and the report then says "not tested"
    before all else. The parts, in the order of cause:

    - ``"action box"``: K_g maps the bounds of the actions onto themselves, by entry;
    - ``"dynamics"``: one ``mj_step`` of the model with contact switched off, by joint;
    - ``"contact"``: one step of the environment with everything switched on, by joint; if this fails
      and ``"dynamics"`` does not, contact is to blame;
    - ``"kinematics"``: the observation of the image is the image of the observation, by entry;
    - ``"reward"``, ``"termination"`` and ``"next observation"`` of that step, the last with what the
      environment remembers then;
    - ``"rollout"``: the state after ``steps`` steps, by joint; reported, never a failure, since contact
      amplifies rounding;
    - ``"reset"``: Kolmogorov-Smirnov distance between mapped and other start observations, by entry.

    Args:
        env: a batched task environment (``reset_to``, ``task.transform_state``), a dm_control
            ``Environment`` or a gymnasium ``MujocoEnv``, these also inside TorchRL's wrappers. It is reset,
            seeded and stepped. Of the last two the state of MuJoCo is mapped, through
            :func:`~torchrl_sym.mujoco.derive`, and ``memory``: a target that the task keeps elsewhere,
            such as a moved geom, stays put and shows as a residual.
        symmetry: representations of the observation's entries (``"observation"`` for an array) and of
            ``"action"``. If it is not strict, entries it does not declare are not tested.
        keyframe: symmetric pose for ``derive``, which finds one by default.
        axis: point (x, y) of the vertical axis that the group acts about, for ``derive``, which finds it by
            default.
        carried: bodies that a turn of the world only carries along, for ``derive``. A batched task
            environment maps its state itself and needs neither.
        states: number of states, rounded up to whole batches; of a batch larger than this, contact-free
            dynamics are tested on so many rows.
        steps: length of the roll-outs.
        tolerance: largest relative residual that passes; 2e-6 for single-precision outputs.
        seed: seed of states and actions.
        observe: applied to every observation before it is compared, such as a normaliser.
        memory: what the environment remembers beside the state of MuJoCo (last actions, a history, a
            phase): attributes of it that hold arrays, with their representations; or
            :class:`~torchrl_sym.mujoco.Remembered`, with functions that save and load.

    Raises:
        TypeError: an environment of another kind, or memory that is no array.
        KeyError: an observation, the action, or something remembered is not declared, or not there.
        ValueError: a size or group differs from its representation's; a number out of its range; or a
            keyframe, carried bodies or memory for a task environment, which would ignore them.
        SymmetryError: the model does not have the group, or a body cannot be carried by an element.

    Example:
        >>> import tasks
        >>> env = tasks.make_env("cartpole", num_envs=16, num_threads=1)
        >>> verify(env, env.symmetry).passed
        True

        Of a gymnasium environment that observes its last two actions, as ``env.last`` and ``env.last2``::

            verify(env, symmetry, memory={"last": robot.actuators, "last2": robot.actuators})
    """
    check_symmetry(symmetry)
    kept = remembered(memory)
    if kept is not None:
        kept.check_group(symmetry.group)
    states, steps = (checks.whole(n, x, 1, MOST) for n, x in (("states", states), ("steps", steps)))
    tolerance = checks.real("tolerance", tolerance, 0.0)
    seed = checks.whole("seed", seed, 0, 2**32 - 1)  # what NumPy takes
    if observe is not None:
        checks.function("observe", observe)
    subject = subject_of(env, symmetry.group, observe, Pose(keyframe, axis, carried), seed, kept)
    if symmetry["action"].dim != len(subject.low):
        raise ValueError(
            f"'action': the environment takes {len(subject.low)} entries, its representation has "
            f"{symmetry['action'].dim}; list every actuator in order"
        )
    generator = torch.Generator().manual_seed(seed)
    found = Measurement(subject, symmetry, tolerance, steps, states, MAX_WARM_UP, generator)
    for _ in range(math.ceil(states / subject.rows)):
        found.add_state()
    found.add_contacts(CONTACTS)
    found.action_box()
    found.resets()
    rows = sorted(found.rows.values(), key=lambda row: PARTS.index(row.part))
    return VerifyReport(
        rows, found.states_tested, found.contacts, symmetry.group.names[0], found.untested()
    )
