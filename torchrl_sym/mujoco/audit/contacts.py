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

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterator

import numpy as np

from torchrl_sym.mujoco.model.filters import Filters, geom_label
from torchrl_sym.mujoco.model.shapes import MESH
from torchrl_sym.mujoco.model.types import MjModel, mj

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
    found: dict[tuple[str, str], list[tuple[int, int]]] = defaultdict(list)
    counts: Counter[tuple[str, str]] = Counter()
    for pairs, count in _unmirrored(model):
        first, second = pairs[0]
        key = _kind(model, first), _kind(model, second)
        found[key] += pairs
        counts[key] += count
    if not found:
        return ()
    listed = ", ".join(
        f"{one} with {other} ({_shown(model, pairs, counts[one, other])})"
        for (one, other), pairs in sorted(found.items())
    )
    return (
        f"contacts of {listed} are not mirrored: MuJoCo finds them by iteration, or keeps a few points of "
        "many, and a mirrored state may move differently; use spheres, capsules and boxes there, or keep "
        "these geoms from meeting (contype and conaffinity, exclude)",
    )


def _unmirrored(model: MjModel) -> Iterator[tuple[list[tuple[int, int]], int]]:
    """Sets of like pairs of geoms whose contacts are not mirrored: the first few, and how many."""
    filters, kinds = Filters(model), model.geom_type
    touching = np.any(filters.may, axis=1, keepdims=True)[filters.of, 0]
    cornered = np.where(touching, 0, -1)  # of what touches nothing it is not asked
    for g in np.flatnonzero(touching & (kinds == MESH)):
        cornered[g] = _has_many_cornered_face(model, int(g))
    keys = np.stack([filters.of, kinds, cornered], axis=1)
    alike, starts, labels = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(labels.reshape(-1), kind="stable")  # some versions of numpy add a dimension
    members = np.split(order, np.cumsum(np.bincount(labels.reshape(-1)))[:-1])

    _, samples, sorts = np.unique(alike[:, 1:], axis=0, return_index=True, return_inverse=True)
    sorts, samples = sorts.reshape(-1), starts[samples]
    mirrored = np.array([
        [_is_mirrored(model, *sorted((int(a), int(b)), key=lambda g: int(kinds[g]))) for b in samples]
        for a in samples
    ], dtype=bool).reshape(len(samples), len(samples))  # fmt: skip
    wrong = filters.may[np.ix_(alike[:, 0], alike[:, 0])] & ~mirrored[np.ix_(sorts, sorts)]
    for i, j in np.argwhere(np.triu(wrong)):
        one, other = sorted((i, j), key=lambda k: (alike[k, 1], starts[k]))
        some = itertools.islice(itertools.product(members[one], members[other]), _NAMED)
        yield [(int(a), int(b)) for a, b in some], len(members[one]) * len(members[other])
    for pair in sorted(filters.pairs):
        first, second = sorted(pair, key=lambda g: int(kinds[g]))
        known = filters.may[filters.of[first], filters.of[second]]
        if not known and not _is_mirrored(model, first, second):
            yield [(first, second)], 1


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


def _shown(model: MjModel, pairs: list[tuple[int, int]], count: int) -> str:
    names = (" and ".join(geom_label(model, g) for g in pair) for pair in sorted(pairs)[:_NAMED])
    return ", ".join(names) + f", {count - _NAMED} more" * (count > _NAMED)
