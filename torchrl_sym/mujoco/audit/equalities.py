"""Equality constraints: is the image of one a constraint of the model?

A constraint may be written in several ways. A linear one between two joints, q1 = a + b q2, is also
q2 = (q1 - a) / b; one between two bodies may name them in either order; and several `connect`s of the same
two bodies close a hinge, whatever points of its axis they are put at.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from torchrl_sym.mujoco.audit.comparison import Comparison
from torchrl_sym.mujoco.audit.shapes import DISCRETE
from torchrl_sym.mujoco.derive.images import Image
from torchrl_sym.mujoco.derive.lengths import Ties, map_lengths
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.rotations import rotation
from torchrl_sym.mujoco.model.types import HINGE, Array, MjData, MjModel, mj, name_of

_OBJECT = mj.mjtObj
_EQ = mj.mjtEq
_CONNECT, _WELD, _JOINT, _TENDON = (
    int(kind) for kind in (_EQ.mjEQ_CONNECT, _EQ.mjEQ_WELD, _EQ.mjEQ_JOINT, _EQ.mjEQ_TENDON)
)
EQUALITIES = (_CONNECT, _WELD, _JOINT, _TENDON)  # the kinds that are compared


def compare_equalities(c: Comparison) -> None:
    """Which constraint is the image of each, and how far off."""
    model, constraints = c.model, _Constraints(c)
    for e in range(model.neq):
        label = name_of(model, "equality", e)
        if int(model.eq_type[e]) not in EQUALITIES:
            c.unchecked.append(f"equality constraint {label!r}, of an unsupported kind")
            continue
        found = ((constraints.residual(e, f), f != e, f) for f in constraints.candidates(e))
        residual, _, f = min(found, default=(1.0, False, e))
        if residual >= 1 and constraints.follows(e):
            c.add(
                "equality constraints", DISCRETE, f"{label} (no single image, but it follows from others)"
            )
            continue
        name = c.name("equality", e, f) if residual < 1 else f"{label} (no image)"
        c.add("equality constraints", residual, name)
        if residual < 1:
            c.fields("equality constraints", ["eq_solref", "eq_solimp", "eq_active0"], e, f, name)


@dataclass
class _Constraints:
    """Compares one constraint's image with another."""

    c: Comparison
    ends: dict[int, tuple[list[int], Array, Array]] = field(default_factory=dict)
    images: dict[int, tuple[list[int], Array, Array]] = field(default_factory=dict)
    binding: dict[tuple[int, ...], list[int]] = field(default_factory=dict)  # what bind the same parts

    def __post_init__(self) -> None:
        model, signs = self.c.model, self.c.map.signs
        self.ties = Ties.of(model)
        self.joints = {j: Image(k, signs.get(j, 1.0)) for j, k in self.c.map.joints.items()}
        for e in range(model.neq):
            if int(model.eq_type[e]) in (_CONNECT, _WELD):
                self.ends[e] = _ends(model, self.c.data, e)
                self.images[e] = _ends(model, self.c.image, e)
            self.binding.setdefault(self._parts(e, self._owners(e)), []).append(e)

    def candidates(self, e: int) -> list[int]:
        """Constraints of the kind of e that bind the images of what it binds."""
        owners = self._owners(e)
        if int(self.c.model.eq_type[e]) in (_CONNECT, _WELD):
            moved = [self.c.map.bodies[owner] for owner in owners]
        else:
            images = self._images(e)
            if any(x >= 0 and x not in images for x in owners):
                return []
            moved = [images[x].index if x >= 0 else -1 for x in owners]
        return self.binding.get(self._parts(e, moved), [])

    def _owners(self, e: int) -> list[int]:
        """The links, joints or tendons that a constraint binds; -1 for none."""
        if e in self.ends:
            return self.ends[e][0]
        return [int(self.c.model.eq_obj1id[e]), int(self.c.model.eq_obj2id[e])]

    def _parts(self, e: int, owners: list[int]) -> tuple[int, ...]:
        return int(self.c.model.eq_type[e]), int(self.c.model.eq_objtype[e]), *sorted(owners)

    def _images(self, e: int) -> dict[int, Image]:
        return self.joints if int(self.c.model.eq_type[e]) == _JOINT else self.c.action.tendons

    def residual(self, e: int, f: int) -> float:
        """How far the image of constraint e is from f, of its kind; 1 if they bind other parts."""
        if int(self.c.model.eq_type[e]) in (_JOINT, _TENDON):
            return self._polynomial(e, f)
        return self._bodies(e, f)

    def _polynomial(self, e: int, f: int) -> float:
        """Coordinates y = p(x) of joints or tendons, about their reference positions."""
        model, is_joint = self.c.model, int(self.c.model.eq_type[e]) == _JOINT
        signs, images = self.c.map.signs, self._images(e)
        mine, theirs = (
            [int(x) for x in (model.eq_obj1id[k], model.eq_obj2id[k])] for k in (e, f)
        )  # -1: none
        if any(x >= 0 and (x not in images or images[x].mixture) for x in mine) or (
            is_joint and any(x >= 0 and x not in signs for x in mine)
        ):
            return 1.0
        moved = [images[x] if x >= 0 else Image(-1) for x in mine]
        worst = 1.0
        for ends, powers in _ways_to_write(theirs, model.eq_data[f, :5]):
            if [image.index for image in moved] == ends:
                image = moved[0].sign * moved[1].sign ** np.arange(5) * model.eq_data[e, :5]
                gap = np.abs(image - powers)[: 1 if mine[1] < 0 else None].max()  # of one end, a constant
                for i, j in zip(mine, ends, strict=True) if is_joint else ():
                    if i >= 0:  # the polynomial is about qpos0
                        q, r = model.qpos0[model.jnt_qposadr[[i, j]]]
                        gap = max(gap, abs(signs[i] * q + self.c.map.offsets[i] - r))
                worst = min(worst, float(gap))
        return worst

    def follows(self, e: int) -> bool:
        """Whether the image of a linear constraint says what others together say, as along a chain."""
        row = np.flatnonzero(np.array(self.ties.equalities, dtype=int) == e)
        if not len(row):
            return False
        matrix, offset = map_lengths(self.c.model, self.c.map, self.c.action.tendons)
        image = matrix @ self.ties.rows[row[0]]
        k = self.ties.combine(image)
        if k is None:
            return False
        # lengths l . x become l . x' with x' = Q x + o
        value = self.ties.values[row[0]] + image @ offset
        return bool(abs(k @ self.ties.values - value) < 1e-6 * max(1.0, np.abs(value)))

    def _bodies(self, e: int, f: int) -> float:
        """Points that a connect or weld joins, and the rotation that a weld asks for."""
        c, weld = self.c, int(self.c.model.eq_type[e]) == _WELD
        (owners, points, turned), (owners_f, points_f, turned_f) = self.ends[e], self.images[f]
        turn, worst, idle = c.matcher.matrix, 1.0, self._idle(owners_f)
        for order in ([0, 1], [1, 0]):
            if [c.map.bodies[owners[k]] for k in order] == owners_f:
                gaps = points[order] @ turn.T - points_f
                apart = np.linalg.norm(gaps, axis=1).max()
                if not weld and idle is not None:  # a constraint along the axis of all hinges does nothing
                    gaps = gaps - np.outer(gaps @ idle, idle)
                    apart = max(np.linalg.norm(gaps, axis=1).max(), min(apart, DISCRETE * c.matcher.extent))
                moved, aligned = points[order] @ turn.T, turned if order == [0, 1] else turned.T
                if weld:  # it asks for one pose, whatever point of the bodies it is put at
                    one, other = moved, points_f
                    beside = float(
                        np.linalg.norm(one[0] - turned_f @ one[1] - other[0] + turned_f @ other[1])
                    )
                else:
                    beside = self._beside(moved, f)
                beside = min(apart, beside)
                gap = max(beside, min(apart, DISCRETE * c.matcher.extent)) / c.matcher.extent
                gap = max(gap, np.abs(turn @ aligned @ turn.T - turned_f).max())
                gap = max(gap, abs(c.model.eq_data[e, 10] - c.model.eq_data[f, 10]) * weld)
                worst = min(worst, float(gap))
        return worst

    def _idle(self, owners: list[int]) -> Array | None:
        """The axis of a planar linkage: of all hinges between two links, if they are parallel."""
        model, chains = self.c.model, []
        for link in owners:
            chain = []
            while link:
                chain.append(link)
                link = int(weld_ids(model)[model.body_parentid[link]])
            chains.append(chain)
        between = set(chains[0]) ^ set(chains[1])
        joints = np.flatnonzero(np.isin(model.jnt_bodyid, list(between)))
        axes = self.c.image.xaxis[joints]
        hinges = (model.jnt_type[joints] == HINGE).all()
        parallel = len(joints) > 0 and np.abs(np.cross(axes, axes[0])).max() < 1e-6
        return axes[0] if hinges and parallel else None

    def _beside(self, points: Array, f: int) -> float:
        """Distance of points from the hinge axis that f and others of its bodies close, if they do."""
        owners = sorted(self.images[f][0])
        same = [
            k
            for k, (others, _, _) in self.images.items()
            if sorted(others) == owners and int(self.c.model.eq_type[k]) == _CONNECT
        ]
        on_axis = np.array([self.images[k][1].mean(axis=0) for k in same])
        direction = on_axis[int(np.linalg.norm(on_axis - on_axis[0], axis=1).argmax())] - on_axis[0]
        if np.linalg.norm(direction) < 1e-3 * self.c.matcher.extent:
            return np.inf
        direction /= np.linalg.norm(direction)
        return float(np.linalg.norm(np.cross(points - on_axis[0], direction), axis=1).max())


def _ways_to_write(ends: list[int], powers: Array) -> list[tuple[list[int], Array]]:
    """The constraint y = p(x) as it is, and with x and y exchanged if it is linear."""
    ways = [(ends, powers)]
    if ends[1] >= 0 and powers[1] != 0.0 and not powers[2:].any():
        ways.append((ends[::-1], np.array([-powers[0], 1.0, 0.0, 0.0, 0.0]) / powers[1]))
    return ways


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
