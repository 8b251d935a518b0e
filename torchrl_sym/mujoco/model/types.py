"""Names for what a compiled model is made of, and whether it is one."""

from __future__ import annotations

import functools
from typing import Any, TypeAlias

import mujoco
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchrl_sym import checks

Array = NDArray[np.float64]
mj: Any = mujoco  # its compiled modules have no type stubs
MjModel: TypeAlias = Any
MjData: TypeAlias = Any
HINGE, SLIDE, BALL, FREE = (
    int(t)
    for t in (
        mj.mjtJoint.mjJNT_HINGE,
        mj.mjtJoint.mjJNT_SLIDE,
        mj.mjtJoint.mjJNT_BALL,
        mj.mjtJoint.mjJNT_FREE,
    )
)


def name_of(model: MjModel, kind: str, index: int) -> str:
    """Name of an element, or its kind and number."""
    return getattr(model, kind)(index).name or f"{kind} {index}"


def label_of(model: MjModel, kind: str, index: int) -> str:
    """Name of an element, for messages; one without a name is said where it is."""
    element = getattr(model, kind)(index)
    if element.name:
        return element.name
    owners = {"body": "body_parentid", "joint": "jnt_bodyid", "geom": "geom_bodyid", "site": "site_bodyid"}
    if kind not in owners or (kind == "body" and index == 0):
        return f"{kind} {index}"
    owner = int(getattr(model, owners[kind])[index])
    return f"{kind} {index} in {name_of(model, 'body', owner)!r}"


@functools.cache
def _numbers() -> list[str]:
    """Names of a model's arrays of real numbers.

    Without the boxes around faces of meshes, of which robots have millions: they follow from the vertices.
    """
    model = mj.MjSpec().compile()
    fields = (name for name in dir(model) if not name.startswith("_"))
    values = {name: getattr(model, name) for name in fields}
    return [
        n
        for n, x in values.items()
        if isinstance(x, np.ndarray) and x.dtype.kind == "f" and n != "bvh_aabb"
    ]


def check_model(model: MjModel) -> MjModel:
    """A compiled model with anything in it, all of whose numbers are finite.

    Raises:
        TypeError: a specification, a file name, data, ...
        ValueError: nothing but the world, or NaN or infinity in a field; the message names it.
    """
    remedy = "spec.compile(), MjModel.from_xml_path(path) or physics.model.ptr of dm_control give one"
    checks.instance("model", model, mj.MjModel, remedy)
    if model.nbody == 1 and not (model.ngeom or model.nsite):
        raise ValueError("model: expected bodies, got the empty world; is this the file of the robot?")
    for name in _numbers():
        if not np.isfinite(getattr(model, name)).all():
            raise ValueError(f"model: expected finite numbers, got NaN or infinity in {name}")
    return model


def check_mocap(model: MjModel, position: Any, rotation: Any) -> None:
    """ValueError unless these are tensors of poses of the model's mocap bodies."""
    for name, x, size in (("position", position, 3), ("rotation", rotation, 4)):
        if not isinstance(x, Tensor) or x.shape[-2:] != (model.nmocap, size):
            raise ValueError(
                f"{name}: expected a tensor (..., {model.nmocap}, {size}), got {checks.shown(x)}"
            )


def dofs_of(model: MjModel, joint: int) -> int:
    """Number of degrees of freedom of a joint."""
    return {FREE: 6, BALL: 3}.get(int(model.jnt_type[joint]), 1)
