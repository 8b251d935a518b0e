"""Images of sites, tendons and actuators: what hangs on links and joints.

A site is mapped by its place on the link. A tendon is mapped by what it couples: a fixed tendon by its
joint coefficients (up to a common sign), a spatial one by its path (in either direction). An actuator is
mapped by its transmission; its sign says whether the image pushes the other way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchrl_sym.mujoco.coordinates import CoordinateMap
from torchrl_sym.mujoco.links import BALL, FREE, Array, Matcher, MjData, MjModel, mj, name_of

_TRANSMISSION = {
    int(getattr(mj.mjtTrn, f"mjTRN_{name.upper()}")): name
    for name in ("joint", "jointinparent", "tendon", "site", "body")
}
_WRAP = mj.mjtWrap


class SymmetryError(ValueError):
    """The model does not have the requested symmetry, not even nearly; the message says why."""


@dataclass
class Image:
    """Where an element goes: the index of its image, a sign, and an offset of its coordinate."""

    index: int
    sign: float = 1.0
    offset: float = 0.0


def map_sites(
    model: MjModel, data: MjData, matcher: Matcher, bodies: dict[int, int], tolerance: float
) -> dict[int, int]:
    """Image of every site that has one: on the image link, where R sends it."""
    images: dict[int, int] = {}
    owner = model.body_weldid[model.site_bodyid]
    for a, b in bodies.items():
        mine, theirs = np.flatnonzero(owner == a), np.flatnonzero(owner == b)
        if not len(mine) or not len(theirs):
            continue
        moved = data.site_xpos[mine] @ matcher.matrix.T
        cost = np.linalg.norm(moved[:, None] - matcher.image.site_xpos[theirs], axis=-1) / matcher.extent
        # sites in one place are told apart by their size and by staying where they are
        sizes = np.abs(model.site_size[mine][:, None] - model.site_size[theirs]).sum(-1)
        cost = cost + 1e-3 * sizes / matcher.extent + 1e-9 * (mine[:, None] != theirs)
        for r, c in zip(*linear_sum_assignment(cost), strict=True):
            if cost[r, c] <= tolerance:
                images[int(mine[r])] = int(theirs[c])
    return images


def map_tendons(model: MjModel, map_: CoordinateMap, sites: dict[int, int]) -> dict[int, Image]:
    """Image of every tendon, with the sign of its length.

    Raises:
        SymmetryError: a tendon couples joints or sites whose images no tendon couples.
    """
    contents = [_tendon(model, t) for t in range(model.ntendon)]
    images = {}
    for t, (kind, parts) in enumerate(contents):
        if kind == "fixed":
            moved = {map_.joints[j]: map_.signs[j] * c for j, c in parts}
            candidates = [(dict(other), s) for _, other in contents for s in (1.0, -1.0)]
            hits = [
                Image(i // 2, sign)
                for i, (other, sign) in enumerate(candidates)
                if contents[i // 2][0] == "fixed"
                and other.keys() == moved.keys()
                and all(abs(moved[j] - sign * other[j]) < 1e-6 for j in moved)
            ]
        else:
            path = [(w, sites.get(o) if w == "site" else None) for w, o in parts]
            hits = [
                Image(i)
                for i, (other_kind, other) in enumerate(contents)
                if other_kind == "spatial" and _same_path(path, other)
            ]
        if not hits:
            raise SymmetryError(
                f"{name_of(model, 'tendon', t)} has no image: no tendon couples the images of what it "
                "couples; add the missing tendon, or use a smaller group"
            )
        images[t] = next((hit for hit in hits if hit.index == t), hits[0])
    return images


def _tendon(model: MjModel, t: int) -> tuple[str, list[tuple]]:
    start, count = int(model.tendon_adr[t]), int(model.tendon_num[t])
    kinds, objects = model.wrap_type[start : start + count], model.wrap_objid[start : start + count]
    if kinds[0] == int(_WRAP.mjWRAP_JOINT):
        coefficients = model.wrap_prm[start : start + count]
        return "fixed", [(int(j), float(c)) for j, c in zip(objects, coefficients, strict=True)]
    names = {int(_WRAP.mjWRAP_SITE): "site", int(_WRAP.mjWRAP_PULLEY): "pulley"}
    return "spatial", [(names.get(int(k), "geom"), int(o)) for k, o in zip(kinds, objects, strict=True)]


def _same_path(path: list[tuple], other: list[tuple]) -> bool:
    def equal(a: list[tuple], b: list[tuple]) -> bool:
        # wrapping geoms are compared by their place in the path only; the audit compares their shapes
        return len(a) == len(b) and all(
            x[0] == y[0] and (x[0] != "site" or x[1] == y[1]) for x, y in zip(a, b, strict=True)
        )

    return equal(path, other) or equal(path[::-1], other)


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
        return (
            1.0
            if map_.bodies.get(int(model.body_weldid[target])) == int(model.body_weldid[other])
            else None
        )
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
