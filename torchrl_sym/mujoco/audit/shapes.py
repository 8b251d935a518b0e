"""Are shapes mapped onto each other, those that may touch something or feel a fluid?

Each geom of a link is paired with the nearest one of its kind on the link's image. Where that fails, the
surfaces decide: a geom that others cover, because it is there twice or is cut into other pieces on the
other side, changes contacts a little and is no asymmetry of the robot; one that sticks out is. Shapes of
the world are *scenery*: a robot does not lose its symmetry by the wall it stands beside, but a task on that
terrain does.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from torchrl_sym.mujoco.audit.comparison import Comparison
from torchrl_sym.mujoco.audit.pairing import pair
from torchrl_sym.mujoco.audit.report import Kind
from torchrl_sym.mujoco.model.filters import active_geoms, feels_fluid, geom_label, lonely_geoms
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.shapes import DIRECTIONS, PLANE, SOLID, geom_supports
from torchrl_sym.mujoco.model.surfaces import outside, surface_points
from torchrl_sym.mujoco.model.types import Array, MjData, MjModel, name_of

# What no number measures: other pieces of one surface, a filter between parts that do not meet.
DISCRETE = 1e-2
# By how much of its bounding radius a geom may reach beyond others that cover it: a foot that is missing
# reaches farther. Pieces of a mesh are cut by chance: they may by more, if it is little of the robot.
_STICKS_OUT, _PIECE, _A_LITTLE = 0.1, 0.5, 0.04
_TERMS: dict[Kind, str] = {
    "collision": "collision geometry",
    "scenery": "scenery geometry",
    "dynamics": "fluid geometry",
}

_CONTACT = ("contype", "conaffinity", "condim", "priority", "friction", "solref", "solimp", "margin")

Numbers = NDArray[np.intp]


@dataclass
class Shapes:
    """Compared geoms, and where they go.

    Attributes:
        geoms: numbers of the geoms, ``(n,)``.
        kinds: what each is judged as: collision, scenery or dynamics.
        mine: support functions of their images, relative to the scale, ``(n, d)``.
        theirs: support functions where images are looked for, ``(n, d)``.
        images: numbers of the geoms that they go to, -1 for none.
        gaps: largest distance of each image from the geom that it goes to, infinite for none.
        sizes: what the image of each is relative to.
        touches: numbers of how they touch; equal for equal contact parameters.
    """

    geoms: Numbers
    kinds: NDArray[np.str_]
    mine: Array
    theirs: Array
    images: Numbers
    gaps: Array
    touches: Numbers
    sizes: Array


def compare_shapes(c: Comparison) -> dict[int, int]:
    """Residuals of shapes; returns the image of every geom that has one."""
    model, lonely = c.model, lonely_geoms(c.model)
    geoms = np.union1d(active_geoms(model), lonely)
    if not len(geoms):
        return {}
    if len(lonely):
        c.warnings.append(_untouched(model, lonely))

    s, places = _shapes(c, geoms), _places(model, geoms)
    others = np.setdiff1d(np.arange(model.ngeom), geoms)
    idle = _places(model, others)
    for link, image in c.map.bodies.items():
        mine, theirs = places.get(link, {}), places.get(image, {})
        _pair_link(s, mine, theirs)
        _look_among(c, s, mine, {kind: others[k] for kind, k in idle.get(image, {}).items()})
        _cover_link(c, s, mine, theirs)

    for kind, term in _TERMS.items():
        some = np.flatnonzero(s.kinds == kind)
        if len(some):
            worst = int(some[np.argmax(s.gaps[some])])
            c.add(term, min(float(s.gaps[worst]), 1.0), _name(c, s, worst), kind=kind)
    return {int(a): int(b) for a, b in zip(geoms, s.images, strict=True) if b >= 0}


def _untouched(model: MjModel, lonely: Numbers) -> str:
    """What is said of geoms that nothing in the file can touch."""
    count = f"{len(lonely)} geom" + "s" * (len(lonely) > 1)
    names = ", ".join(geom_label(model, int(g)) for g in lonely[:2]) + ", ..." * (len(lonely) > 2)
    return (
        f"contacts of {count} ({names}): nothing in this file can touch them, only their shapes were "
        "compared; audit the scene with the floor"
    )


def _shapes(c: Comparison, geoms: Numbers) -> Shapes:
    model, turn = c.model, c.matcher.matrix
    owners = weld_ids(model)[model.geom_bodyid[geoms]].astype(np.intp)
    moved = np.array([c.map.bodies.get(int(b), int(b)) for b in owners])
    world, here, there = owners == 0, _sizes(c, owners), _sizes(c, moved)
    return Shapes(
        geoms,
        np.where(world, "scenery", np.where(feels_fluid(model)[geoms], "dynamics", "collision")),
        _features(model, c.data, geoms, turn, there),
        _features(model, c.image, geoms, np.eye(3), here),
        np.full(len(geoms), -1),
        np.full(len(geoms), np.inf),
        _contact_labels(model)[geoms],
        there,
    )


def _sizes(c: Comparison, links: Numbers) -> Array:
    """What shapes of links are relative to: of an object beside a robot, its own size."""
    known = {link: c.matcher.size(link) for link in set(links.tolist())}
    return np.array([known[link] for link in links.tolist()])


def _contact_labels(model: MjModel) -> Numbers:
    """Equal numbers for geoms of equal contact parameters, ``(ngeom,)``."""
    fields = [np.asarray(getattr(model, f"geom_{f}"), dtype=float) for f in _CONTACT]
    values = np.concatenate([field.reshape(model.ngeom, -1) for field in fields], axis=1)
    return np.unique(values, axis=0, return_inverse=True)[1].reshape(-1)


def _features(model: MjModel, pose: MjData, geoms: Numbers, turn: Array, sizes: Array) -> Array:
    """Support functions of the images of geoms, relative to sizes; of planes, normal and height."""
    out = geom_supports(model, pose, geoms, DIRECTIONS @ turn) / sizes[:, None]
    planes = np.flatnonzero(model.geom_type[geoms] == PLANE)
    normals = pose.geom_xmat[geoms[planes]].reshape(-1, 3, 3)[:, :, 2]
    out[planes, :3] = normals @ turn.T
    out[planes, 3] = (normals * pose.geom_xpos[geoms[planes]]).sum(axis=1) / sizes[planes]
    return out


def _places(model: MjModel, geoms: Numbers) -> dict[int, dict[int, Numbers]]:
    """Where the geoms of each link are in an array of geoms, by their types."""
    owner, places = weld_ids(model)[model.geom_bodyid[geoms]], defaultdict(lambda: defaultdict(list))
    for i, (link, kind) in enumerate(zip(owner.tolist(), model.geom_type[geoms].tolist(), strict=True)):
        places[link][kind].append(i)
    return {link: {kind: np.array(some) for kind, some in kinds.items()} for link, kinds in places.items()}


def _pair_link(s: Shapes, mine: dict[int, Numbers], theirs: dict[int, Numbers]) -> None:
    """Pair each geom of a link with one of its kind on the link's image."""
    for kind, rows in mine.items():
        columns = theirs.get(kind, np.array([], dtype=np.intp))
        labels = s.touches[rows], s.touches[columns]
        one, other = pair(s.mine[rows], s.theirs[columns], s.geoms[rows], s.geoms[columns], labels)
        one, other = rows[one], columns[other]
        s.images[one] = s.geoms[other]
        s.gaps[one] = np.abs(s.mine[one] - s.theirs[other]).max(axis=1, initial=0.0)


def _look_among(c: Comparison, s: Shapes, mine: dict[int, Numbers], idle: dict[int, Numbers]) -> None:
    """Look for images among geoms that can touch nothing: there it is the filters that differ."""
    for kind in mine.keys() & idle.keys():
        rest, others = mine[kind][s.gaps[mine[kind]] > DISCRETE], idle[kind]
        if not len(rest):
            continue
        centers = c.data.geom_xpos[s.geoms[rest]] @ c.matcher.matrix.T
        apart = KDTree(centers).query(c.image.geom_xpos[others])[0]
        others = others[apart <= DISCRETE * c.matcher.extent]  # meshes for the eye are large
        owners = weld_ids(c.model)[c.model.geom_bodyid[others]].astype(np.intp)
        there = _features(c.model, c.image, others, np.eye(3), _sizes(c, owners))
        one, other = pair(s.mine[rest], there, s.geoms[rest], others)
        gaps = np.abs(s.mine[rest[one]] - there[other]).max(axis=1, initial=0.0)
        fit = gaps <= DISCRETE
        s.images[rest[one[fit]]], s.gaps[rest[one[fit]]] = others[other[fit]], gaps[fit]


def _cover_link(c: Comparison, s: Shapes, mine: dict[int, Numbers], theirs: dict[int, Numbers]) -> None:
    """Ask the surfaces about geoms that have no image of their own, the worst first.

    Once one sticks out, nothing that follows is worse. A fluid acts on every geom, so that there pieces are
    no remedy.
    """
    none = np.array([], dtype=np.intp)
    rest, cover = (
        np.concatenate([none, *(some[k] for k in SOLID if k in some)]) for some in (mine, theirs)
    )
    rest = rest[(s.gaps[rest] > DISCRETE) & (s.kinds[rest] != "dynamics")]
    for i in rest[np.argsort(-s.gaps[rest], kind="stable")]:
        geom = int(s.geoms[i])
        reach = _reach(c, geom, s.geoms[cover])
        radius, extent = c.model.geom_rbound[geom], c.matcher.extent
        allowed = max(_STICKS_OUT * radius, min(_PIECE * radius, _A_LITTLE * extent))
        if reach > allowed or reach / s.sizes[i] > s.gaps[i] / 2:
            return
        s.gaps[i] = reach / s.sizes[i]
        nearest = cover[np.abs(s.theirs[cover] - s.mine[i]).max(axis=1).argmin()]
        if s.images[i] < 0:
            s.images[i] = s.geoms[nearest]  # whose contact parameters it must have
        body = name_of(c.model, "body", int(c.model.geom_bodyid[s.geoms[nearest]]))
        name = f"{geom_label(c.model, geom)} (no single image, but geoms of {body!r} cover it)"
        kind = cast(Kind, str(s.kinds[i]))
        c.add(f"{kind} pieces", DISCRETE, name, kind=kind)


def _reach(c: Comparison, geom: int, others: Numbers) -> float:
    """How far the image of a geom sticks out of some others; infinite if it meets none of them."""
    model, turn = c.model, c.matcher.matrix
    apart = np.linalg.norm(c.image.geom_xpos[others] - turn @ c.data.geom_xpos[geom], axis=1)
    near = others[apart <= model.geom_rbound[geom] + model.geom_rbound[others]]
    if not len(near):
        return np.inf
    points = surface_points(model, c.data, geom) @ turn.T
    return float(np.min([outside(model, c.image, int(b), points) for b in near], axis=0).max())


def _name(c: Comparison, s: Shapes, i: int) -> str:
    """Which geom goes where, or which one is nearest and how far."""
    geom = int(s.geoms[i])
    label = geom_label(c.model, geom)
    other = int(s.images[i])
    if other >= 0:
        return label if other == geom else f"{label} -> {geom_label(c.model, other)}"
    link = c.map.bodies[int(weld_ids(c.model)[c.model.geom_bodyid[geom]])]
    owner = weld_ids(c.model)[c.model.geom_bodyid[s.geoms]]
    candidates = np.flatnonzero((owner == link) & (c.model.geom_type[s.geoms] == c.model.geom_type[geom]))
    if not len(candidates):
        return f"{label} (no image)"
    gaps = np.abs(s.theirs[candidates] - s.mine[i]).max(axis=1)
    nearest = geom_label(c.model, int(s.geoms[candidates[gaps.argmin()]]))
    return f"{label} (no image; {nearest} is nearest, {1e3 * s.sizes[i] * gaps.min():.3g} mm off)"
