"""Are collision shapes, contact parameters and collision filters mapped onto each other?"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from torchrl_sym.mujoco.audit.comparison import column_scale
from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.shapes import DIRECTIONS, active_geoms, support, touching
from torchrl_sym.mujoco.model.types import Array, MjData, MjModel, mj, name_of

Add: TypeAlias = Callable[[str, float, str], None]  # (term, residual, name of the element)
_GEOM = mj.mjtGeom
PLANE = int(_GEOM.mjGEOM_PLANE)
_MISFIT = 1e3
_PARAMETERS = {
    "friction": ("geom_friction",),
    "condim": ("geom_condim",),
    "priority": ("geom_priority",),
    "contact solref/solimp": ("geom_solref", "geom_solimp", "geom_solmix"),
    "contact margin": ("geom_margin", "geom_gap", "geom_adhesion"),
}
_PAIR_FIELDS = ("dim", "friction", "solref", "solreffriction", "solimp", "margin", "gap", "adhesion")


def shape_residual(model: MjModel, data: MjData, matcher: Matcher, a: int, b: int) -> float:
    """Largest distance between the image of geom a and geom b, relative to the model's extent."""
    kind = int(model.geom_type[a])
    if kind != int(model.geom_type[b]):
        return _MISFIT
    turn, image = matcher.matrix, matcher.image
    if kind == PLANE:  # infinite for contacts, so that only its height along the normal matters
        normal = image.geom_xmat[b].reshape(3, 3)[:, 2]
        tilt = float(np.abs(turn @ data.geom_xmat[a].reshape(3, 3)[:, 2] - normal).max())
        offset = turn @ data.geom_xpos[a] - image.geom_xpos[b]
        return max(tilt, abs(float(normal @ offset)) / matcher.extent)

    def at(pose: MjData, geom: int, directions: Array) -> Array:
        vertices = None
        if kind == _GEOM.mjGEOM_MESH:
            mesh = int(model.geom_dataid[geom])
            start = int(model.mesh_vertadr[mesh])
            vertices = model.mesh_vert[start : start + int(model.mesh_vertnum[mesh])]
        rotation = pose.geom_xmat[geom].reshape(3, 3)
        return support(kind, model.geom_size[geom], pose.geom_xpos[geom], rotation, directions, vertices)

    return support_gap(matcher, at, a, b)


def support_gap(matcher: Matcher, at: Callable[[MjData, int, Array], Array], a: int, b: int) -> float:
    gap = np.abs(at(matcher.data, a, DIRECTIONS @ matcher.matrix) - at(matcher.image, b, DIRECTIONS))
    return float(gap.max()) / matcher.extent


def audit_geoms(model: MjModel, data: MjData, matcher: Matcher, bodies: dict[int, int], add: Add) -> None:
    """Residuals of shapes, contact parameters, collision bits, excludes and explicit pairs."""
    if model.ngeom == 0:
        return
    active = active_geoms(model)
    images = _geom_images(model, data, matcher, bodies, active, add)
    for term, fields in _PARAMETERS.items():
        for field in fields:
            values = np.asarray(getattr(model, field), dtype=float).reshape(model.ngeom, -1)
            scale = column_scale(values[active])
            for a, b in images.items():
                add(term, float((np.abs(values[a] - values[b]) / scale).max()), _label(model, a, b))
    _audit_filters(model, images, add)
    _audit_pairs(model, images, add)


def _geom_images(
    model: MjModel,
    data: MjData,
    matcher: Matcher,
    bodies: dict[int, int],
    active: NDArray[np.intp],
    add: Add,
) -> dict[int, int]:
    images: dict[int, int] = {}
    owner = weld_ids(model)[model.geom_bodyid[active]]
    for link, link_image in bodies.items():
        mine, theirs = active[owner == link], active[owner == link_image]
        cost = np.array([[shape_residual(model, data, matcher, a, b) for b in theirs] for a in mine])
        cost = cost.reshape(len(mine), len(theirs))
        # geoms in one place are told apart by staying where they are
        rows, columns = linear_sum_assignment(cost + 1e-9 * (mine[:, None] != theirs))
        for r, c in zip(rows, columns, strict=True):
            if cost[r, c] < _MISFIT:
                a, b = int(mine[r]), int(theirs[c])
                images[a] = b
                add("collision geometry", float(cost[r, c]), _label(model, a, b))
        for a in set(mine.tolist()) - images.keys():
            add("collision geometry", 1.0, f"{name_of(model, 'geom', a)} (no image)")
    return images


def _audit_filters(model: MjModel, images: dict[int, int], add: Add) -> None:
    """Bits and excludes: the images of geoms that may collide must be allowed to, and the other way."""
    signatures = np.asarray(model.exclude_signature)
    excluded = np.zeros((model.nbody, model.nbody), dtype=bool)
    excluded[signatures >> 16, signatures & 0xFFFF] = True
    excluded |= excluded.T
    bits = touching(model)
    mine, theirs = np.array(list(images), dtype=int), np.array(list(images.values()), dtype=int)
    tables = {
        "contype/conaffinity": bits,
        "excludes": bits & excluded[np.ix_(model.geom_bodyid, model.geom_bodyid)],
    }
    for term, table in tables.items():
        wrong = np.argwhere(table[np.ix_(mine, mine)] != table[np.ix_(theirs, theirs)])
        if len(wrong):
            first, second = (name_of(model, "geom", int(mine[k])) for k in wrong[0])
            add(term, 1.0, f"{first} with {second}")
        elif table.any():
            add(term, 0.0, "")


def _audit_pairs(model: MjModel, images: dict[int, int], add: Add) -> None:
    known = {
        frozenset((int(a), int(b))): p
        for p, (a, b) in enumerate(zip(model.pair_geom1, model.pair_geom2, strict=True))
    }
    for pair, p in known.items():
        moved = known.get(frozenset(images.get(geom, -1) for geom in pair))
        name = name_of(model, "pair", p)
        if moved is None:
            add("contact pairs", 1.0, f"{name} (no image)")
            continue
        for field in _PAIR_FIELDS:
            values = np.asarray(getattr(model, f"pair_{field}"), dtype=float).reshape(model.npair, -1)
            residual = np.abs(values[p] - values[moved]) / column_scale(values)
            add("contact pairs", float(residual.max()), name)


def _label(model: MjModel, a: int, b: int) -> str:
    name = name_of(model, "geom", a)
    return name if a == b else f"{name} -> {name_of(model, 'geom', b)}"
