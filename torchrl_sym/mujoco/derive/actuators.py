"""Images of actuators, which are mapped by their transmission.

The sign says whether the image pushes the other way.
"""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.derive.coordinates import CoordinateMap
from torchrl_sym.mujoco.derive.images import Image, SymmetryError
from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.types import BALL, FREE, Array, MjModel, mj, name_of

_TRANSMISSION = {
    int(getattr(mj.mjtTrn, f"mjTRN_{name.upper()}")): name
    for name in ("joint", "jointinparent", "tendon", "site", "body")
}


def map_actuators(
    matcher: Matcher,
    map_: CoordinateMap,
    sites: dict[int, int],
    tendons: dict[int, Image],
) -> dict[int, Image]:
    """Image of every actuator, with the sign and offset of its control.

    Raises:
        SymmetryError: an actuator's transmission is of an unsupported kind, or no actuator drives the
            image of what it drives.
    """
    model = matcher.model
    images: dict[int, Image] = {}
    for a in range(model.nu):
        fits = []
        for b in range(model.nu):
            sign = _transmission_sign(matcher, map_, sites, tendons, a, b)
            if sign is not None:
                fits.append((_gain_distance(model, a, b), b != a, b, sign))
        free = [fit for fit in sorted(fits) if fit[2] not in {image.index for image in images.values()}]
        if not free:
            raise SymmetryError(
                f"{name_of(model, 'actuator', a)} has no image: no actuator drives the image of what it "
                "drives; add the missing actuator, or use a smaller group"
            )
        b, sign = free[0][2], free[0][3]
        images[a] = Image(b, sign, _control_offset(model, map_, a, b))
    return images


def _transmission_sign(
    matcher: Matcher,
    map_: CoordinateMap,
    sites: dict[int, int],
    tendons: dict[int, Image],
    a: int,
    b: int,
) -> float | None:
    """Sign between actuator a's image and actuator b, None if b does not drive a's image."""
    model = matcher.model
    kind = _TRANSMISSION.get(int(model.actuator_trntype[a]))
    if kind is None:
        raise SymmetryError(
            f"{name_of(model, 'actuator', a)} has a transmission of an unsupported kind; supported are "
            f"{sorted(set(_TRANSMISSION.values()))}"
        )
    has_reference = kind == "site" and int(model.actuator_trnid[a, 1]) >= 0
    in_parent = kind == "jointinparent" and _dofs(model, int(model.actuator_trnid[a, 0])) > 1
    if has_reference or in_parent:
        raise SymmetryError(
            f"{name_of(model, 'actuator', a)} acts in another frame (reference site, or parent of a ball "
            "or free joint), which is not supported; use a joint or a plain site transmission"
        )
    if int(model.actuator_trntype[b]) != int(model.actuator_trntype[a]):
        return None
    target, other = int(model.actuator_trnid[a, 0]), int(model.actuator_trnid[b, 0])
    gear, gear_other = model.actuator_gear[a], model.actuator_gear[b]
    if kind == "tendon":
        tendon = tendons[target]
        scalar = tendon.sign * np.sign(gear[0] * gear_other[0])
        return float(scalar) if tendon.index == other else None
    if kind == "body":
        return 1.0 if map_.bodies.get(int(weld_ids(model)[target])) == int(weld_ids(model)[other]) else None
    if kind == "site":
        if sites.get(target) != other:
            return None
        frame = _site_frame(matcher, target, other)
        torque = round(float(np.linalg.det(frame))) * frame @ gear[3:]
        return _parallel(np.concatenate([frame @ gear[:3], torque]), gear_other)
    if map_.joints.get(target) != other:
        return None
    if target in map_.signs:
        return float(map_.signs[target] * np.sign(gear[0] * gear_other[0]))
    rows = slice(int(model.jnt_dofadr[target]), int(model.jnt_dofadr[target]) + _dofs(model, target))
    columns = slice(int(model.jnt_dofadr[other]), int(model.jnt_dofadr[other]) + _dofs(model, target))
    size = _dofs(model, target)
    return _parallel(map_.qvel[columns, rows] @ gear[:size], gear_other[:size])


def _dofs(model: MjModel, joint: int) -> int:
    return {FREE: 6, BALL: 3}.get(int(model.jnt_type[joint]), 1)


def _site_frame(matcher: Matcher, a: int, b: int) -> Array:
    """V of a site: how a polar vector in the frame of site a becomes one in the frame of its image b."""
    one, other = matcher.data.site_xmat[a].reshape(3, 3), matcher.image.site_xmat[b].reshape(3, 3)
    return other.T @ matcher.matrix @ one


def _parallel(image: Array, target: Array) -> float | None:
    for sign in (1.0, -1.0):
        if np.allclose(image, sign * target, atol=1e-6 * max(1.0, float(np.abs(target).max()))):
            return sign
    return None


def _gain_distance(model: MjModel, a: int, b: int) -> float:
    """How different two actuators of one transmission are: a joint may have several."""
    kinds = ("actuator_dyntype", "actuator_gaintype", "actuator_biastype")
    distance = sum(1e3 for field in kinds if int(getattr(model, field)[a]) != int(getattr(model, field)[b]))
    for field in ("actuator_gainprm", "actuator_biasprm"):
        distance += float(np.abs(getattr(model, field)[a] - getattr(model, field)[b]).sum())
    return distance


def _control_offset(model: MjModel, map_: CoordinateMap, a: int, b: int) -> float:
    """Offset of the control of a position servo on a joint whose coordinate has an offset."""
    is_joint = _TRANSMISSION.get(int(model.actuator_trntype[a])) in ("joint", "jointinparent")
    target = int(model.actuator_trnid[a, 0])
    servo = model.actuator_biasprm[a, 1] != 0
    if not (is_joint and servo and target in map_.offsets):
        return 0.0
    return float(model.actuator_gear[b, 0]) * map_.offsets[target]
