"""Derive the symmetry of a robot from its MuJoCo model: which joint goes where, with which sign.

Hand-written mirror tables are the most common bug of symmetric learning. `derive` finds them from the
model: it matches the links at one pose that the group keeps, reads the signs off the joint axes, and checks
that the result is a representation. It works for any joint order and any choice of body frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup, check_group
from torchrl_sym.mujoco.derive.action import Action
from torchrl_sym.mujoco.derive.coordinates import map_coordinates
from torchrl_sym.mujoco.derive.images import SymmetryError
from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.derive.symmetry import ModelSymmetry
from torchrl_sym.mujoco.model.links import carried_bodies, links_of
from torchrl_sym.mujoco.model.poses import reference_pose
from torchrl_sym.mujoco.model.rotations import quaternion
from torchrl_sym.mujoco.model.types import Array, MjModel, check_model, name_of
from torchrl_sym.representations import orientations


def derive(
    model: MjModel,
    group: PointGroup,
    keyframe: int | str | None = None,
    *,
    tolerance: float = 1e-2,
    carried: Sequence[str] = (),
) -> ModelSymmetry:
    """How each element of a group acts on a model.

    Args:
        model: the compiled model.
        group: the group to try; it acts about the vertical axis through the world's origin.
        keyframe: a pose that the group keeps, by name or number. Defaults to ``qpos0``.
        tolerance: largest mismatch of a joint that still counts as its image's: 1 - cos of the angle
            between the axes, plus the distance of the anchors relative to the model's extent.
        carried: names of free bodies (one free joint) and mocap bodies that a turn of the world only
            carries along: their rotation X becomes R X, their own frame stays. That is right for objects
            of any shape, but exists for turns of odd order only. The rotation of other bodies becomes
            R X V^-1, which is right for objects that have the group's symmetry themselves.

    Returns:
        The action on joints, actuators, sites, tendons and the full state. Whether masses, ranges and
        shapes agree as well is for :func:`~torchrl_sym.mujoco.audit` to say.

    Raises:
        SymmetryError: a joint, actuator or tendon has no image, or a body cannot be carried by an
            element; the message names it.
        ValueError: the group tilts gravity, or a body that is neither free nor mocap, or that moving
            bodies hang on, is to be carried.
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
        if not torch.allclose(matrix @ gravity, gravity, atol=1e-9):
            raise ValueError(
                f"{name!r} tilts gravity {gravity.tolist()}; use a group that fixes the vertical axis, or "
                "switch gravity off in the model"
            )
    objects = carried_bodies(model, carried)
    lifts = _lifts(model, group, objects)
    data = reference_pose(model, keyframe)
    links = links_of(model, data)
    actions = []
    for name, matrix, lift in zip(group.names, group.matrices, lifts, strict=True):
        matcher = Matcher(model, data, links, matrix.numpy(), lift, objects)
        images = matcher.links_to()
        joints = _joint_images(model, matcher, images, name, tolerance)
        actions.append(
            Action(model, matcher, map_coordinates(model, data, links, matcher, images, joints), tolerance)
        )
    return ModelSymmetry(model, group, actions)


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


def _joint_images(
    model: MjModel, matcher: Matcher, images: dict[int, int], element: str, tolerance: float
) -> dict[int, int]:
    """Image of every joint; SymmetryError if one is not where the symmetry sends it."""
    joints: dict[int, int] = {}
    for a, link in matcher.links.items():
        mine = link.joints
        b = images.get(a)
        pairs = {} if b is None else matcher.joints_to(a, b)
        if b is None or len(pairs) != len(mine):
            raise SymmetryError(
                f"{name_of(model, 'body', a)} has no image under {element!r}: no body with as many joints "
                "and children is left on the other side"
            )
        for i, j in pairs.items():
            misfit = matcher.joint_cost(i, j)
            if misfit > tolerance:
                raise SymmetryError(
                    f"{name_of(model, 'joint', i)} has no image under {element!r}: the nearest, "
                    f"{name_of(model, 'joint', j)}, misses it by {misfit:.2g} (axis and anchor; tolerance "
                    f"{tolerance:g}); is the pose symmetric? pass keyframe=... for another one"
                )
        joints |= pairs
    return joints
