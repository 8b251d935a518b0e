"""Which contacts does MuJoCo not mirror, however symmetric the model is?

Between planes, spheres, capsules and boxes there are formulas, and the contacts of a mirrored state are the
mirrored contacts. For all other pairs of convex shapes MuJoCo walks through the hulls (GJK and EPA, or
libccd) until a tolerance is met: where it starts and stops, and which points of a patch it keeps, depends
on the side from which it looks. The step of a mirrored state then differs by up to 1 m/s, although nothing
in the model does (https://github.com/google-deepmind/mujoco/issues/420).

The table below was measured: contacts of the image against images of the contacts, of every pair of kinds,
under reflections and turns, with native and libccd collision. Exactly parallel poses are ties for any
routine; no simulation stays in them.
"""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.model.shapes import touching
from torchrl_sym.mujoco.model.types import MjModel, mj, name_of

_GEOM, _DISABLE = mj.mjtGeom, mj.mjtDisableBit
_KINDS = {
    int(_GEOM.mjGEOM_PLANE): "plane",
    int(_GEOM.mjGEOM_HFIELD): "height field",
    int(_GEOM.mjGEOM_SPHERE): "sphere",
    int(_GEOM.mjGEOM_CAPSULE): "capsule",
    int(_GEOM.mjGEOM_ELLIPSOID): "ellipsoid",
    int(_GEOM.mjGEOM_CYLINDER): "cylinder",
    int(_GEOM.mjGEOM_BOX): "box",
    int(_GEOM.mjGEOM_MESH): "mesh",
    int(_GEOM.mjGEOM_SDF): "signed distance field",
}
_FIELDS = ("plane", "height field")  # which never meet each other
_EXACT = {
    "plane": ("sphere", "capsule", "ellipsoid", "cylinder", "box"),
    "sphere": ("sphere", "capsule", "cylinder", "box"),
    "capsule": ("capsule", "box"),
    "box": ("box",),
}
_CORNERS = 4  # MuJoCo keeps at most so many contacts of a face that lies on a plane
_APART = 0.3  # and only those so far from the first, in bounding radii
_NAMED = 2  # pairs of geoms that are named for each pair of kinds


def colliding_geoms(model: MjModel) -> list[tuple[int, int]]:
    """Pairs of geoms between which MuJoCo looks for contacts: by bits, bodies, excludes and explicit pairs.

    Example:
        >>> model = mj.MjModel.from_xml_string('''<mujoco><worldbody>
        ...   <geom type="plane" size="1 1 1"/><geom type="box" size="1 1 .1"/>
        ...   <body><freejoint/><geom size=".1"/></body></worldbody></mujoco>''')
        >>> colliding_geoms(model)
        [(0, 2), (1, 2)]
    """
    if model.opt.disableflags & int(_DISABLE.mjDSBL_CONTACT | _DISABLE.mjDSBL_CONSTRAINT):
        return []
    body = model.geom_bodyid
    link = model.body_weldid[body]
    moves = model.body_dofnum[link] > 0
    found = touching(model) & (moves[:, None] | moves)
    if not model.opt.disableflags & int(_DISABLE.mjDSBL_FILTERPARENT):
        parent = model.body_weldid[model.body_parentid[link]]
        child = (parent[:, None] == link) & (link[:, None] != 0) & (link != 0)
        found &= ~(child | child.T)
    for signature in np.asarray(model.exclude_signature):
        one, other = body == signature >> 16, body == signature & 0xFFFF
        found &= ~(np.outer(one, other) | np.outer(other, one))
    found[model.pair_geom1, model.pair_geom2] = found[model.pair_geom2, model.pair_geom1] = True
    return [(int(a), int(b)) for a, b in np.argwhere(np.triu(found))]


def contact_warnings(model: MjModel) -> tuple[str, ...]:
    """A sentence on the pairs of geoms whose contacts are not mirrored, if there are any.

    Example:
        >>> model = mj.MjModel.from_xml_string('''<mujoco><worldbody>
        ...   <geom name="floor" type="box" size="1 1 .1"/>
        ...   <body><freejoint/><geom name="foot" type="cylinder" size=".1 .1"/></body>
        ... </worldbody></mujoco>''')
        >>> contact_warnings(model)[0].split(":")[0]
        'contacts of cylinder with box (foot and floor) are not mirrored'
    """
    kinds: dict[tuple[str, str], list[str]] = {}
    for pair in colliding_geoms(model):
        first, second = sorted(pair, key=lambda g: int(model.geom_type[g]))
        if not _is_mirrored(model, first, second):
            names = (name_of(model, "geom", g) for g in (first, second))
            key = _kind(model, first), _kind(model, second)
            kinds.setdefault(key, []).append(" and ".join(names))
    if not kinds:
        return ()
    listed = ", ".join(f"{a} with {b} ({_shown(names)})" for (a, b), names in sorted(kinds.items()))
    return (
        f"contacts of {listed} are not mirrored: MuJoCo finds them by iteration, or keeps a few points of "
        "many, and a mirrored state may move differently; use spheres, capsules and boxes there, or keep "
        "these geoms from meeting (contype and conaffinity, exclude)",
    )


def _is_mirrored(model: MjModel, first: int, second: int) -> bool:
    """Whether the contacts of two geoms, the first of an earlier kind, are mirrored to rounding."""
    one, other = _kind(model, first), _kind(model, second)
    if other in _EXACT.get(one, ()) or (one in _FIELDS and other in _FIELDS):
        return True
    if (one, other) == ("sphere", "mesh"):  # native collision shrinks the sphere to its centre
        return not model.opt.disableflags & int(_DISABLE.mjDSBL_NATIVECCD)
    return (one, other) == ("plane", "mesh") and not _has_many_cornered_face(model, second)


def _has_many_cornered_face(model: MjModel, geom: int) -> bool:
    """Whether a mesh may stand on more corners than MuJoCo keeps."""
    mesh = int(model.geom_dataid[geom])
    vertices = model.mesh_vert[int(model.mesh_vertadr[mesh]) :]
    faces = int(model.mesh_polyadr[mesh]) + np.arange(int(model.mesh_polynum[mesh]))
    for face in faces[model.mesh_polyvertnum[faces] > _CORNERS]:
        start, count = int(model.mesh_polyvertadr[face]), int(model.mesh_polyvertnum[face])
        corners = vertices[model.mesh_polyvert[start : start + count]]
        if np.linalg.norm(corners - corners[:1], axis=1).max() > _APART * model.geom_rbound[geom]:
            return True
    return False


def _kind(model: MjModel, geom: int) -> str:
    return _KINDS[int(model.geom_type[geom])]


def _shown(names: list[str]) -> str:
    more = f", {len(names) - _NAMED} more" * (len(names) > _NAMED)
    return ", ".join(names[:_NAMED]) + more
