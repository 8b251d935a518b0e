"""Equality constraints: is the image of one a constraint of the model?"""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.audit.comparison import Comparison
from torchrl_sym.mujoco.derive.coordinates import CoordinateMap
from torchrl_sym.mujoco.derive.images import Image
from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.rotations import rotation
from torchrl_sym.mujoco.model.types import Array, MjData, MjModel, mj, name_of

_OBJECT = mj.mjtObj
_EQ = mj.mjtEq
_WELD, _JOINT, _TENDON = int(_EQ.mjEQ_WELD), int(_EQ.mjEQ_JOINT), int(_EQ.mjEQ_TENDON)
EQUALITIES = (int(_EQ.mjEQ_CONNECT), _WELD, _JOINT, _TENDON)  # the kinds that are compared


def compare_equalities(c: Comparison) -> None:
    """Which constraint is the image of each, and how far off."""
    model = c.model
    for e in range(model.neq):
        label = name_of(model, "equality", e)
        if int(model.eq_type[e]) not in EQUALITIES:
            c.unchecked.append(f"equality constraint {label!r}, of an unsupported kind")
            continue
        tendons = c.action.tendons
        fits = [
            (
                equality_residual(model, c.data, c.matcher, c.map, tendons, e, f),
                f != e,
                f,
            )
            for f in range(model.neq)
        ]
        residual, _, f = min(fits)
        name = c.name("equality", e, f) if residual < 1 else f"{label} (no image)"
        c.add("equality constraints", residual, name)
        if residual < 1:
            c.fields("equality constraints", ["eq_solref", "eq_solimp", "eq_active0"], e, f, name)


def equality_residual(
    model: MjModel,
    data: MjData,
    matcher: Matcher,
    map_: CoordinateMap,
    tendons: dict[int, Image],
    e: int,
    f: int,
) -> float:
    """How far the image of equality constraint e is from constraint f; 1 if they bind other parts."""
    if model.eq_type[e] != model.eq_type[f] or model.eq_objtype[e] != model.eq_objtype[f]:
        return 1.0
    kind = int(model.eq_type[e])
    mine, theirs = ([int(x) for x in (model.eq_obj1id[k], model.eq_obj2id[k])] for k in (e, f))  # -1: none
    if kind in (_JOINT, _TENDON):
        if kind == _JOINT:
            images = {j: Image(k, map_.signs.get(j, 1.0)) for j, k in map_.joints.items()}
        else:
            images = tendons
        moved = [images[x] if x >= 0 else Image(-1) for x in mine]
        if [image.index for image in moved] != theirs:
            return 1.0
        powers = moved[0].sign * moved[1].sign ** np.arange(5)
        gap = np.abs(powers * model.eq_data[e, :5] - model.eq_data[f, :5]).max()
        for i, j in zip(mine, theirs, strict=True) if kind == _JOINT else ():
            if i >= 0:  # the polynomial is about qpos0
                q, r = model.qpos0[model.jnt_qposadr[[i, j]]]
                gap = max(gap, abs(map_.signs[i] * q + map_.offsets[i] - r))
        return min(float(gap), 1.0)
    turn = matcher.matrix
    owners, points, rotation = _ends(model, data, e)
    owners_f, points_f, rotation_f = _ends(model, matcher.image, f)
    worst = 1.0
    for order in ([0, 1], [1, 0]):
        if [map_.bodies[owners[k]] for k in order] == owners_f:
            gap = np.linalg.norm(points[order] @ turn.T - points_f, axis=1).max() / matcher.extent
            aligned = rotation if order == [0, 1] else rotation.T
            gap = max(gap, np.abs(turn @ aligned @ turn.T - rotation_f).max())
            gap = max(gap, abs(model.eq_data[e, 10] - model.eq_data[f, 10]) * (kind == _WELD))
            worst = min(worst, float(gap))
    return worst


def _ends(model: MjModel, data: MjData, e: int) -> tuple[list[int], Array, Array]:
    """Links, the points (world) that a connect or weld joins, and the rotation that a weld asks for."""
    kind, prm = int(model.eq_type[e]), model.eq_data[e]
    one, other = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
    by_site = int(model.eq_objtype[e]) == int(_OBJECT.mjOBJ_SITE)
    if by_site:
        bodies, points = model.site_bodyid[[one, other]], data.site_xpos[[one, other]]
        frames = data.site_xmat[[one, other]].reshape(2, 3, 3)
    else:
        bodies, frames = np.array([one, other]), data.xmat[[one, other]].reshape(2, 3, 3)
        anchors = [prm[3:6], prm[:3]] if kind == _WELD else [prm[:3], prm[3:6]]
        points = data.xpos[bodies] + np.einsum("kij,kj->ki", frames, np.array(anchors))
    owners = [int(weld_ids(model)[body]) for body in bodies]
    if kind != _WELD:
        return owners, points, np.eye(3)
    relative = np.eye(3) if by_site else rotation(prm[6:10])
    return owners, points, frames[0] @ relative @ frames[1].T
