"""Randomised physics for an evaluation: the same draw for every equivalent goal of a start.

Goals are compared on images of the same starts, so what a task draws for its physics
(:meth:`~tasks.base.Task.randomize`) must be paired too: episode k of goal g needs the image under g of the
draw of episode k. Draws that the group leaves as they are, such as one factor on all friction or a mass
added to the base, are their own images: every goal gets the same. A draw for each leg would have to change
legs with the goal; it is refused.

Which draws are of the first kind is read off the model. To be kept by a group is a linear condition on
masses, friction, damping or gains, so a random mean of all draws meets it exactly if every draw does.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from tasks.base import Task
from tasks.environment import BatchedEnv
from torchrl_sym.mujoco import audit

# What may be drawn: fields that `audit` compares, and in which the action of the group is linear.
PAIRED_FIELDS = (
    *("body_mass", "body_inertia", "body_ipos", "body_gravcomp"),
    *("dof_armature", "dof_damping", "dof_frictionloss", "jnt_stiffness", "jnt_range", "jnt_actfrcrange"),
    *("geom_friction", "geom_solref", "geom_solimp", "geom_margin", "geom_gap"),
    *("actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange", "actuator_forcerange"),
)
TOLERANCE = 1e-8  # of a change in what `audit` finds, relative; that of an exact model


def draw_paired_physics(env: BatchedEnv, seed: int) -> None:
    """Randomise the physics of an environment whose rows are the same episodes of every goal, goal by goal.

    Does nothing for a task that randomises nothing.

    Args:
        env: rows as :meth:`~tasks.base.Task.sample_goal_states` orders them.
        seed: of the draws.

    Raises:
        ValueError: the draws do not follow from the generator they are given, change a field that is not
            among ``PAIRED_FIELDS``, or are not kept by the group.

    Example:
        >>> import tasks
        >>> env = tasks.make_env("trifinger_repose", num_envs=6, num_threads=1, cube_mass=(0.06, 0.1))
        >>> draw_paired_physics(env, seed=0)
        >>> mass = env.simulation.expand("body_mass")[:, env.task.model.body("cube").id]
        >>> bool((mass[:2] == mass[2:4]).all()), len(mass.unique())
        (True, 2)
    """
    task, order = env.task, env.task.symmetry.group.order
    place = env.simulation.qpos.device
    for rows in torch.arange(env.batch_size[0], device=place).reshape(order, -1):
        task.randomize(env.simulation, rows, torch.Generator(place).manual_seed(seed))
    drawn = {
        key.removeprefix("model."): values.cpu().reshape(order, -1, *values.shape[1:])
        for key, values in env.simulation.save().items()
        if key.startswith("model.")
    }
    for name, values in drawn.items():
        if not bool((values == values[0]).all()):
            raise ValueError(
                f"expected {type(task).__name__}.randomize to draw from its generator alone, got different "
                f"{name} from equal seeds; pass the generator to every random function"
            )
    changed = {name: values[0] for name, values in drawn.items() if not _nominal(task, name, values[0])}
    if changed:
        _check(task, changed)


def _nominal(task: Task, name: str, values: Tensor) -> bool:
    own = getattr(task.model, name, None)  # None for `opt.gravity` and the like
    return own is not None and bool((values == torch.from_numpy(own.copy()).to(values.dtype)).all())


def _check(task: Task, drawn: dict[str, Tensor]) -> None:
    """The draws of all episodes, ``(episodes, ...)`` each, are kept by the group."""
    remedy = "evaluate the task without it, by leaving out its range"
    unknown = [name for name in drawn if name not in PAIRED_FIELDS]
    if unknown:
        raise ValueError(
            f"expected {type(task).__name__}.randomize to draw some of {list(PAIRED_FIELDS)}, which can be "
            f"paired between equivalent goals, got {unknown}; {remedy}"
        )
    mean = copy.copy(task.model)
    for name, values in drawn.items():
        weights = 0.5 + torch.rand(len(values), generator=torch.Generator().manual_seed(0)).double()
        getattr(mean, name)[:] = torch.tensordot(weights / weights.sum(), values.double(), 1).numpy()
    group, carried = task.symmetry.group, task.carried
    before, after = (
        {(row.element, row.term): row for row in audit(model, group, carried=carried).residuals}
        for model in (task.model, mean)
    )
    for place, row in after.items():
        known = before[place].residual if place in before else 0.0
        if not abs(row.residual - known) <= TOLERANCE:
            raise ValueError(
                f"expected {type(task).__name__}.randomize to draw values that the group leaves as they "
                f"are, since goals are compared on the same draws, got {row.term} that {row.element!r} "
                f"changes ({row.name}); draw one value for all parts that are images of each other, or "
                f"{remedy}"
            )
    if before.keys() - after.keys():
        raise ValueError(
            f"expected {type(task).__name__}.randomize to keep the model symmetric, got one that lacks the "
            f"symmetry; {remedy}"
        )
