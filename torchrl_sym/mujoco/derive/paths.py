"""Paths of spatial tendons, compared part by part.

A tendon's length is the sum over its branches (pulleys begin one) of their lengths divided by a divisor.
Each branch runs straight from site to site, or around a sphere or cylinder between two of them: inside it
if the side site is inside, else on the side that the direction of the side site says.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.derive.sites import site_gap
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.types import Array, MjData, MjModel, label_of, mj

_SITE, _PULLEY, _CYLINDER = (
    int(getattr(mj.mjtWrap, f"mjWRAP_{n}")) for n in ("SITE", "PULLEY", "CYLINDER")
)
_MISFIT = 1e3  # of paths whose parts are of other kinds


@dataclass(frozen=True)
class Branch:
    """Parts of a path that follow each other: kind of wrapping object, its number, its side site or -1."""

    divisor: float
    parts: list[tuple[int, int, int]]


def branches(model: MjModel, tendon: int) -> list[Branch]:
    """The branches of a spatial tendon."""
    start, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
    found = [Branch(1.0, [])]
    for w in range(start, start + count):
        kind, number, value = int(model.wrap_type[w]), int(model.wrap_objid[w]), float(model.wrap_prm[w])
        if kind == _PULLEY:
            found.append(Branch(value, []))
        else:
            found[-1].parts.append((kind, number, round(value) if kind != _SITE else -1))
    return [branch for branch in found if branch.parts]


def links_of_path(model: MjModel, tendon: int) -> list[tuple[int, int]]:
    """Kinds of the objects on the path of a spatial tendon, and the links that they are on."""
    welds = weld_ids(model)
    return [
        (kind, int(welds[(model.site_bodyid if kind == _SITE else model.geom_bodyid)[number]]))
        for branch in branches(model, tendon)
        for kind, number, _ in branch.parts
    ]


def side_sites(model: MjModel) -> set[int]:
    """Sites that say on which side of a geom a tendon passes."""
    wraps = ~np.isin(model.wrap_type, (_SITE, _PULLEY, int(mj.mjtWrap.mjWRAP_JOINT)))
    return {round(side) for side in model.wrap_prm[wraps].tolist() if side >= 0}


def path_gap(matcher: Matcher, t: int, u: int) -> float:
    """How far the image of the path of spatial tendon t is from that of u, relative; 0 if exact."""
    mine, theirs = branches(matcher.model, t), branches(matcher.model, u)
    if len(mine) != len(theirs):
        return _MISFIT
    cost = np.array([[_branch_gap(matcher, a, b) for b in theirs] for a in mine])
    rows, columns = linear_sum_assignment(cost)
    return float(cost[rows, columns].max(initial=0.0))


def _branch_gap(matcher: Matcher, a: Branch, b: Branch) -> float:
    if len(a.parts) != len(b.parts):
        return _MISFIT
    ratio = abs(a.divisor - b.divisor) / max(a.divisor, b.divisor)
    return max(ratio, min(_parts_gap(matcher, a.parts, parts) for parts in (b.parts, b.parts[::-1])))


def _parts_gap(matcher: Matcher, mine: list, theirs: list) -> float:
    worst = 0.0
    for one, other in zip(mine, theirs, strict=True):
        if one[0] != other[0]:
            return _MISFIT
        if one[0] == _SITE:
            gap = site_gap(matcher, one[1], other[1])
        else:
            gap = max(_wrap_gap(matcher, one[1], other[1]), side_gap(matcher, one, other))
        worst = max(worst, gap)
    return min(worst, _MISFIT)


def _wrap_gap(matcher: Matcher, a: int, b: int) -> float:
    """How far wrapping geom b is from the image of a: its place, radius and, of a cylinder, axis."""
    model = matcher.model
    owners = weld_ids(model)[model.geom_bodyid[[a, b]]]
    if matcher.images.get(int(owners[0])) != int(owners[1]) or model.geom_type[a] != model.geom_type[b]:
        return _MISFIT
    gap, turn = matcher.matrix @ matcher.data.geom_xpos[a] - matcher.image.geom_xpos[b], 0.0
    if int(model.geom_type[b]) == int(mj.mjtGeom.mjGEOM_CYLINDER):  # it wraps as if it were endless
        axis = matcher.image.geom_xmat[b].reshape(3, 3)[:, 2]
        turn = float(np.linalg.norm(np.cross(matcher.matrix @ _z_axis(matcher.data, a), axis)))
        gap = gap - (gap @ axis) * axis
    thicker = abs(float(model.geom_size[a, 0] - model.geom_size[b, 0]))
    return max(turn, (float(np.linalg.norm(gap)) + thicker) / matcher.size(int(owners[1])))


def _z_axis(data: MjData, geom: int) -> Array:
    return data.geom_xmat[geom].reshape(3, 3)[:, 2]


def side_gap(matcher: Matcher, one: tuple[int, int, int], other: tuple[int, int, int]) -> float:
    """How far a tendon's side of a geom is from the image of another's: 0 the same, 1 the opposite."""
    if (one[2] < 0) != (other[2] < 0):
        return _MISFIT  # without a side site it takes the shorter way
    if one[2] < 0:
        return 0.0
    model = matcher.model
    owners = weld_ids(model)[model.site_bodyid[[one[2], other[2]]]]
    if matcher.images.get(int(owners[0])) != int(owners[1]):
        return _MISFIT
    arms, insides = [], []
    for data, (kind, geom, site), turn in (
        (matcher.data, one, matcher.matrix),
        (matcher.image, other, np.eye(3)),
    ):
        arm, axis = data.site_xpos[site] - data.geom_xpos[geom], _z_axis(data, geom)
        insides.append(bool(np.linalg.norm(arm) < model.geom_size[geom, 0]))
        arms.append(turn @ (arm - (arm @ axis) * axis if kind == _CYLINDER else arm))
    if insides[0] != insides[1]:
        return _MISFIT
    if insides[0]:
        return 0.0
    a, b = (arm / max(float(np.linalg.norm(arm)), 1e-12) for arm in arms)
    return float(np.linalg.norm(a - b)) / 2


def path_words(matcher: Matcher, t: int) -> str:
    """Which side site keeps a tendon from having an image, if one does."""
    model = matcher.model
    for u in range(model.ntendon):
        mine, theirs = branches(model, t), branches(model, u)
        pairs = zip(mine, theirs, strict=False)
        for one, other in ((a, b) for x, y in pairs for a, b in zip(x.parts, y.parts, strict=False)):
            sided = one[0] == other[0] != _SITE and min(one[2], other[2]) >= 0
            if (
                sided
                and _wrap_gap(matcher, one[1], other[1]) < 1e-2
                and side_gap(matcher, one, other) > 0.1
            ):
                sides = [label_of(model, "site", x[2]) for x in (one, other)]
                return (
                    f"side site {sides[1]} is not on the side of {label_of(model, 'geom', other[1])} that "
                    f"{sides[0]} is sent to; move it, "
                )
    return ""
