"""Are collision shapes, contact settings, sites and constraints mapped onto each other?

Two convex bodies are equal if and only if their support functions h(d) = max over their points p of d . p
are: under the isometry R a shape A becomes one with h_RA(d) = h_A(R^T d). So shapes are compared by what
they are, whatever frame or sign a modeller gave them: a sphere may be turned, a capsule flipped. Meshes
collide by their convex hull, hence the same comparison holds for their vertices.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from torchrl_sym.mujoco.coordinates import CoordinateMap, rotation
from torchrl_sym.mujoco.elements import Image, map_sites
from torchrl_sym.mujoco.links import (
    Array,
    Matcher,
    MjData,
    MjModel,
    mj,
    name_of,
)

Add: TypeAlias = Callable[[str, float, str], None]  # (term, residual, name of the element)

_GEOM, _OBJECT, _SENSOR = mj.mjtGeom, mj.mjtObj, mj.mjtSensor
_EQ = mj.mjtEq
_WELD, _JOINT, _TENDON = int(_EQ.mjEQ_WELD), int(_EQ.mjEQ_JOINT), int(_EQ.mjEQ_TENDON)
EQUALITIES = (int(_EQ.mjEQ_CONNECT), _WELD, _JOINT, _TENDON)  # the kinds that are compared
_PLANE = int(_GEOM.mjGEOM_PLANE)
_MISFIT = 1e3
_PARAMETERS = {
    "friction": ("geom_friction",),
    "condim": ("geom_condim",),
    "priority": ("geom_priority",),
    "contact solref/solimp": ("geom_solref", "geom_solimp", "geom_solmix"),
    "contact margin": ("geom_margin", "geom_gap", "geom_adhesion"),
}
_PAIR_FIELDS = ("dim", "friction", "solref", "solreffriction", "solimp", "margin", "gap", "adhesion")


def _directions(count: int = 96) -> Array:
    """Unit vectors spread over the sphere in a spiral that no point group keeps."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count) + 0.1
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


_DIRECTIONS = _directions()


def support(
    kind: int,
    size: Array,
    center: Array,
    rotation: Array,
    directions: Array,
    vertices: Array | None = None,
) -> Array:
    """Support function of a primitive or of the hull of vertices, at each direction ``(n, 3)``."""
    local = directions @ rotation
    if kind == _GEOM.mjGEOM_SPHERE:
        reach = np.full(len(local), size[0])
    elif kind == _GEOM.mjGEOM_CAPSULE:
        reach = size[0] + size[1] * np.abs(local[:, 2])
    elif kind == _GEOM.mjGEOM_CYLINDER:
        reach = size[0] * np.linalg.norm(local[:, :2], axis=1) + size[1] * np.abs(local[:, 2])
    elif kind == _GEOM.mjGEOM_ELLIPSOID:
        reach = np.linalg.norm(local * size, axis=1)
    elif kind == _GEOM.mjGEOM_BOX:
        reach = np.abs(local) @ size
    elif vertices is not None:
        reach = (local @ vertices.T).max(axis=1)
    else:
        reach = np.zeros(len(local))  # only the place is compared
    return directions @ center + reach


def shape_residual(model: MjModel, data: MjData, matcher: Matcher, a: int, b: int) -> float:
    """Largest distance between the image of geom a and geom b, relative to the model's extent."""
    kind = int(model.geom_type[a])
    if kind != int(model.geom_type[b]):
        return _MISFIT
    turn, image = matcher.matrix, matcher.image
    if kind == _PLANE:  # infinite for contacts, so that only its height along the normal matters
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

    return _support_gap(matcher, at, a, b)


def _support_gap(matcher: Matcher, at: Callable[[MjData, int, Array], Array], a: int, b: int) -> float:
    gap = np.abs(at(matcher.data, a, _DIRECTIONS @ matcher.matrix) - at(matcher.image, b, _DIRECTIONS))
    return float(gap.max()) / matcher.extent


def touching(model: MjModel) -> NDArray[np.bool_]:
    """Which pairs of geoms may collide according to their bits, before excludes; ``(ngeom, ngeom)``."""
    if model.opt.disableflags & int(mj.mjtDisableBit.mjDSBL_CONTACT):
        return np.zeros((model.ngeom, model.ngeom), dtype=bool)
    bits = (model.geom_contype[:, None] & model.geom_conaffinity) != 0
    link = model.body_weldid[model.geom_bodyid]
    return (bits | bits.T) & (link[:, None] != link)


def active_geoms(model: MjModel) -> NDArray[np.intp]:
    """Numbers of the geoms that matter for motion: they may collide or feel a fluid."""
    active = np.array(touching(model).any(axis=1))
    if not model.opt.disableflags & int(mj.mjtDisableBit.mjDSBL_CONTACT):
        active[model.pair_geom1] = active[model.pair_geom2] = True
    if model.opt.density > 0 or model.opt.viscosity > 0:
        active |= model.geom_fluid[:, 0] > 0
    return np.flatnonzero(active)


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
    owner = model.body_weldid[model.geom_bodyid[active]]
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


def audit_sites(
    model: MjModel, data: MjData, matcher: Matcher, bodies: dict[int, int], add: Add
) -> list[str]:
    """Residuals of the sites that something uses; returns the names of other sites out of place."""

    def at(pose: MjData, site: int, directions: Array) -> Array:
        rotation, kind = pose.site_xmat[site].reshape(3, 3), int(model.site_type[site])
        return support(kind, model.site_size[site], pose.site_xpos[site], rotation, directions)

    images = map_sites(model, data, matcher, bodies, np.inf)
    used, loose = _used_sites(model), []
    touch = set(model.sensor_objid[model.sensor_type == int(_SENSOR.mjSENS_TOUCH)].tolist())
    for a in range(model.nsite):
        b = images.get(a)
        if b is None:
            residual, name = 1.0, f"{name_of(model, 'site', a)} (no image)"
        else:
            turned = matcher.matrix @ data.site_xpos[a]
            residual = float(np.linalg.norm(turned - matcher.image.site_xpos[b])) / matcher.extent
            name = name_of(model, "site", a)
            name += f" -> {name_of(model, 'site', b)}" if a != b else ""
            if a in touch:  # such a sensor feels the contacts inside the site
                residual = max(residual, _support_gap(matcher, at, a, b))
        if a in used:
            add("sites", residual, name)
        elif residual > 1e-6:
            loose.append(name)
    return loose


def _used_sites(model: MjModel) -> set[int]:
    """Sites that a sensor, actuator, tendon or equality constraint refers to."""
    kind = int(_OBJECT.mjOBJ_SITE)
    by_site = model.actuator_trntype == int(mj.mjtTrn.mjTRN_SITE)
    groups = (
        model.actuator_trnid[by_site].ravel(),
        model.wrap_objid[model.wrap_type == int(mj.mjtWrap.mjWRAP_SITE)],
        model.sensor_objid[model.sensor_objtype == kind],
        model.sensor_refid[model.sensor_reftype == kind],
        model.eq_obj1id[model.eq_objtype == kind],
        model.eq_obj2id[model.eq_objtype == kind],
    )
    return {int(site) for group in groups for site in group if site >= 0}


def path_residual(model: MjModel, data: MjData, matcher: Matcher, t: int, u: int) -> float:
    """Wrapping geoms and pulleys of spatial tendon t against those of u, in the better direction."""
    a, b, count = int(model.tendon_adr[t]), int(model.tendon_adr[u]), int(model.tendon_num[t])

    def residual(order: Iterable[int]) -> float:
        worst = 0.0
        for k, m in enumerate(order):
            kind, objects = int(model.wrap_type[a + k]), model.wrap_objid[[a + k, b + m]]
            if kind != int(model.wrap_type[b + m]):
                return 1.0
            if kind in (int(mj.mjtWrap.mjWRAP_SPHERE), int(mj.mjtWrap.mjWRAP_CYLINDER)):
                worst = max(worst, shape_residual(model, data, matcher, int(objects[0]), int(objects[1])))
            elif kind == int(mj.mjtWrap.mjWRAP_PULLEY):
                worst = max(worst, abs(float(model.wrap_prm[a + k] - model.wrap_prm[b + m])))
        return min(worst, 1.0)

    return min(residual(range(count)), residual(range(count - 1, -1, -1)))


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
    owners = [int(model.body_weldid[body]) for body in bodies]
    if kind != _WELD:
        return owners, points, np.eye(3)
    relative = np.eye(3) if by_site else rotation(prm[6:10])
    return owners, points, frames[0] @ relative @ frames[1].T


def column_scale(values: Array) -> Array:
    """Largest magnitude in each column, 1 for a column of zeros."""
    if not len(values):
        return np.ones(values.shape[1:])
    scale = np.abs(values).max(axis=0)
    return np.where(scale > 0, scale, 1.0)


def _label(model: MjModel, a: int, b: int) -> str:
    name = name_of(model, "geom", a)
    return name if a == b else f"{name} -> {name_of(model, 'geom', b)}"
