"""Derive the symmetry of a robot from its MuJoCo model: which joint goes where, with which sign.

Hand-written mirror tables are the most common bug of symmetric learning. `derive` finds them from the
model: it finds a pose and an axis that the group keeps, matches the links there, reads the signs off the
joint axes, and checks that the result is a representation. It works for any joint order and any choice of
body frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup, check_group
from torchrl_sym.mujoco.derive.action import Action
from torchrl_sym.mujoco.derive.chains import mixing_axes
from torchrl_sym.mujoco.derive.coordinates import map_coordinates
from torchrl_sym.mujoco.derive.images import SymmetryError
from torchrl_sym.mujoco.derive.search import Search
from torchrl_sym.mujoco.derive.symmetry import ModelSymmetry
from torchrl_sym.mujoco.model.links import carried_bodies
from torchrl_sym.mujoco.model.rotations import quaternion
from torchrl_sym.mujoco.model.types import Array, MjModel, check_model, name_of
from torchrl_sym.representations import orientations

_TILT = 2e-2  # of gravity by an element: a model's vertical may be off by 0.01 rad, which the audit reports


def derive(
    model: MjModel,
    group: PointGroup,
    keyframe: int | str | None = None,
    *,
    tolerance: float = 1e-2,
    carried: Sequence[str] = (),
    axis: tuple[float, float] | None = None,
) -> ModelSymmetry:
    """How each element of a group acts on a model.

    Args:
        model: the compiled model.
        group: the group to try; it acts about a vertical axis.
        keyframe: a pose that the group keeps, by name or number. By default the first that fits of qpos0,
            the keyframes, all joints at zero or at the middle of their ranges, and one that is solved for.
            Where free bodies stand and look in it does not matter: they are moved onto the axis.
        tolerance: largest mismatch of a joint that still counts as its image's: 1 - cos of the angle
            between the axes, plus the distance of the anchors relative to the size of what moves. A link's
            centre of mass may miss its image's by ten times as much.
        carried: names of free bodies (one free joint) and mocap bodies that a turn of the world only
            carries along: their rotation X becomes R X, their own frame stays. That is right for objects
            of any shape, but exists for turns of odd order only. The rotation of other bodies becomes
            R X V^-1, which is right for objects that have the group's symmetry themselves.
        axis: a point (x, y) of the axis that the group acts about, in metres. By default the world's
            origin, or where the model has it: the plane between two arms on a table.

    Returns:
        The action on joints, actuators, sites, tendons and the full state. Whether masses, ranges and
        shapes agree as well is for :func:`~torchrl_sym.mujoco.audit` to say.

    Raises:
        SymmetryError: the group tilts gravity, a link, joint, actuator or tendon has no image in any pose,
            or a body cannot be carried by an element; the message names it, the nearest candidate and how
            far off that is.
        ValueError: a body that is neither free nor mocap, or that moving bodies hang on, is to be carried.
        KeyError: no such keyframe, or no such body to be carried.

    Example:
        >>> import mujoco
        >>> from torchrl_sym import PointGroup
        >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody>
        ...   <body name="left" pos="0 .1 0"><joint name="left" axis="1 0 0"/><geom size=".1"/></body>
        ...   <body name="right" pos="0 -.1 0"><joint name="right" axis="1 0 0"/><geom size=".1"/></body>
        ... </worldbody></mujoco>''')
        >>> robot = derive(model, PointGroup.reflection("y"))
        >>> robot.table("joint", "reflect-y")
        {'left': '-right', 'right': '-left'}
    """
    gravity = torch.as_tensor(np.array(check_model(model).opt.gravity))
    tolerance = checks.real("tolerance", tolerance, 0.0)
    for name, matrix in zip(check_group(group).names, group.matrices, strict=True):
        if (matrix @ gravity - gravity).norm() > _TILT * gravity.norm():
            raise SymmetryError(
                f"{name!r} tilts gravity {gravity.tolist()}; use a group that fixes the vertical axis, or "
                "switch gravity off in the model"
            )
    objects = carried_bodies(model, carried)
    lifts = _lifts(model, group, objects)
    found = Search(model, group, lifts, tolerance, objects, _checked(axis)).find(keyframe)
    matchers = found.matchers
    slides = mixing_axes(
        matchers[0].pairing.parts, [(m.matrix, m.images, m.joint_pairs()) for m in matchers]
    )
    actions = [Action(m, map_coordinates(m, slides), tolerance) for m in matchers]
    try:
        return ModelSymmetry(model, group, actions, pose=found.words, ambiguous=found.ambiguous)
    except ValueError as error:
        raise SymmetryError(f"the images of the elements do not make a group: {error}") from error


def _checked(axis: tuple[float, float] | None) -> tuple[float, float] | None:
    if axis is None:
        return None
    place = checks.sequence("axis", axis, "two numbers")
    if len(place) != 2:
        raise ValueError(f"axis: expected a point (x, y), got {checks.shown(axis)}")
    return checks.real("axis", place[0]), checks.real("axis", place[1])


def _lifts(model: MjModel, group: PointGroup, carried: frozenset[int]) -> list[Array]:
    """A quaternion of each element; where bodies are carried along, those that compose without a sign."""
    if not carried:
        return [quaternion(d * m) for d, m in zip(group.det.numpy(), group.matrices.numpy(), strict=True)]
    try:
        left = orientations.quaternion(group, "left").matrices
    except ValueError as error:
        names = ", ".join(name_of(model, "body", b) for b in sorted(carried))
        reason = str(error).split(";")[0]  # its remedy is about observations
        raise SymmetryError(
            f"{names} cannot be carried along: {reason}; leave it out of `carried`, which maps its "
            "rotation by conjugation, valid for an object that is symmetric under the group"
        ) from error
    return list(left[:, :, 0].numpy())  # of 1, for each element
