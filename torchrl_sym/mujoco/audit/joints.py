"""Axes, anchors, ranges, springs and losses of joints."""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.audit.comparison import Comparison, column_scale
from torchrl_sym.mujoco.audit.shapes import DISCRETE
from torchrl_sym.mujoco.model.types import BALL, FREE, HINGE, SLIDE, Array, dofs_of, mj

_ANGLE = 1e-6  # rad or m; a coordinate of qpos0 that is further from its image's is not symmetric


def compare_joints(c: Comparison) -> None:
    """Axes, anchors, ranges, stiffness and limits."""
    model, data, turn = c.model, c.data, c.matcher.matrix  # no carried body has an axis
    rest = c.map.qpos @ model.qpos_spring + c.map.qpos_offset
    mine, theirs = (np.array([*x], dtype=np.intp) for x in (c.map.joints, c.map.joints.values()))
    angles = np.linalg.norm(np.cross(data.xaxis[mine] @ turn.T, data.xaxis[theirs]), axis=1).tolist()
    lengths = np.linalg.norm(model.jnt_axis, axis=1)
    gaps = data.xanchor[mine] @ turn.T - data.xanchor[theirs]
    beside = np.linalg.norm(np.cross(gaps, data.xaxis[theirs]), axis=1)
    away = np.where(model.jnt_type[mine] == HINGE, beside, np.linalg.norm(gaps, axis=1)).tolist()
    springs = c.efforts.scale("stiffness", model.jnt_stiffness[model.dof_jntid])[model.jnt_dofadr]
    alike = {kind: np.flatnonzero(model.jnt_type == kind) for kind in (HINGE, SLIDE, BALL, FREE)}
    for (i, j), angle, apart in zip(c.map.joints.items(), angles, away, strict=True):
        name, kind = c.name("joint", i, j), int(model.jnt_type[i])
        sign, shift = c.map.signs.get(i, 1.0), c.map.offsets.get(i, 0.0)
        if i in c.map.mixed:
            _compare_mixing(c, i, name)
        elif kind in (HINGE, SLIDE):
            length = abs(float(lengths[i] - lengths[j]))
            c.add("joint axis", max(angle, length), name, amount=f"{np.degrees(angle):.2g} deg")
        if kind != FREE:
            apart = 0.0 if kind == SLIDE else apart  # a slide's anchor does not matter
            c.add("joint anchor", apart / c.matcher.extent, name, amount=f"{1e3 * apart:.2g} mm")
        if i not in c.map.mixed:
            c.range("joint range", "jnt_range", "jnt_limited", i, j, sign, shift, name)
            c.range("joint force range", "jnt_actfrcrange", "jnt_actfrclimited", i, j, sign, 0.0, name)
        stiffness = model.jnt_stiffness[[i, j]] / springs[j]
        c.add("stiffness", float(abs(stiffness[0] - stiffness[1])), name)
        c.fields("stiffness", ["jnt_stiffnesspoly"], i, j, name, alike[kind])
        c.fields("joint gravity compensation", ["jnt_actgravcomp"], i, j, name, alike[kind])
        if model.jnt_limited[i] or model.jnt_limited[j]:
            c.fields("joint solref/solimp", ["jnt_solref", "jnt_solimp", "jnt_margin"], i, j, name)
        if model.jnt_stiffness[i] > 0:
            start, size = int(model.jnt_qposadr[j]), {FREE: 7, BALL: 4}.get(kind, 1)
            one, other = rest[start : start + size], model.qpos_spring[start : start + size]
            if kind in (FREE, BALL):  # a quaternion and its negative are one rotation
                one = np.concatenate([one[:-4], one[-4:] * np.sign(one[-4:] @ other[-4:] or 1.0)])
            scale = c.matcher.extent if kind == SLIDE else 1.0
            c.add("springref", float(np.abs(one - other).max()) / scale, name)


def _compare_mixing(c: Comparison, i: int, name: str) -> None:
    """A slide whose coordinate enters those of several: what its axis becomes; no box may limit it."""
    axes = sum(weight * c.data.xaxis[k] for k, weight in c.map.mixed[i].items())
    c.add("joint axis", float(np.linalg.norm(c.matcher.matrix @ c.data.xaxis[i] - axes)), name)
    if np.any(getattr(c.model, "jnt_stiffnesspoly", np.zeros((c.model.njnt, 1)))[i]):
        c.add("stiffness", 1.0, f"{name} (springs that are not linear, which the element turns)")
    for term, limited in (("joint range", "jnt_limited"), ("joint force range", "jnt_actfrclimited")):
        if getattr(c.model, limited)[i]:
            c.add(term, 1.0, f"{name} (a box, which the element turns)")


def compare_order(c: Comparison) -> None:
    """Whether the joints of one body act one after the other as those of its image do."""
    for body, gap in c.map.order.items():
        c.add("joint order", gap, c.name("body", body, c.map.bodies[body]))


def compare_dofs(c: Comparison) -> None:
    """Damping, armature and friction loss: M diag(x) M^T = diag(x) with M the map of velocities."""
    model = c.model
    tied = _tied_dofs(c)
    for term in ("damping", "armature", "frictionloss"):
        _compare_losses(c, term, np.array(getattr(model, f"dof_{term}")), tied, term != "frictionloss")
    for column in getattr(model, "dof_dampingpoly", np.zeros((model.nv, 0))).T:
        _compare_losses(c, "damping", np.array(column), tied, linear=False)
    for i, j in c.map.joints.items():
        a, b = int(model.jnt_dofadr[i]), int(model.jnt_dofadr[j])
        if model.dof_frictionloss[a] > 0:
            c.fields("joint solref/solimp", ["dof_solref", "dof_solimp"], a, b, c.name("joint", i, j))


def _compare_losses(
    c: Comparison, term: str, values: Array, tied: list[tuple[int, int]], linear: bool = True
) -> None:
    """One number per dof. Where a constraint makes two dofs one, only their sum acts."""
    if not values.any():
        return
    scale = c.efforts.scale(term, values)
    gap = _gap(c, values, scale)
    if not linear:  # friction of two slides is bounded by a box, which must not be turned
        gap = gap + np.abs(values) / scale * _turned(c.map.qvel)
    if gap.max(initial=0.0) > 0.0 and tied:
        shared = values.copy()
        for a, b in tied:
            shared[[a, b]] = shared[[a, b]].mean()
        exchanged = np.unique(np.array(tied))
        gap[exchanged] = np.maximum(_gap(c, shared, scale)[exchanged], np.minimum(gap[exchanged], DISCRETE))
    for i, j in c.map.joints.items():
        start = int(c.model.jnt_dofadr[j])
        stop = start + dofs_of(c.model, j)
        c.add(term, float(gap[start:stop].max()), c.name("joint", i, j))


def _turned(matrix: Array) -> Array:
    """How far each row of an orthogonal matrix is from having a single entry, 0 to 1."""
    shares = 1 - np.abs(matrix).max(axis=1, initial=0.0)
    return np.where(shares > 1e-12, shares, 0.0)


def _gap(c: Comparison, values: Array, scale: Array) -> Array:
    turn = c.map.qvel
    gap = np.abs(turn @ np.diag(values) @ turn.T - np.diag(values))
    return (gap / np.sqrt(np.outer(scale, scale))).max(axis=1, initial=0.0)


def _tied_dofs(c: Comparison) -> list[tuple[int, int]]:
    """Dofs of joints that move alike, up to a sign, because an active equality constraint says so."""
    model, out = c.model, []
    for e in np.flatnonzero((model.eq_type == int(mj.mjtEq.mjEQ_JOINT)) & model.eq_active0.astype(bool)):
        powers, other = model.eq_data[e, :5], int(model.eq_obj2id[e])
        if other >= 0 and abs(powers[1]) == 1.0 and not powers[2:].any():
            out.append((int(model.jnt_dofadr[model.eq_obj1id[e]]), int(model.jnt_dofadr[other])))
    return out


def compare_constraint_weights(c: Comparison) -> None:
    """What MuJoCo weighs constraints with. It follows from the rest, at ``qpos0``, symmetric or not."""
    model = c.model
    if any(row.residual > 1e-9 for row in c.worst.values() if row.kind == "dynamics"):
        return  # they differ as well then, and say nothing new
    moved = c.map.qpos @ model.qpos0 + c.map.qpos_offset - model.qpos0
    scalar = [int(model.jnt_qposadr[j]) for i, j in c.map.joints.items() if i in c.map.signs]
    kept = float(np.abs(moved[scalar]).max(initial=0.0)) < _ANGLE
    gap = _gap(c, model.dof_invweight0, column_scale(model.dof_invweight0) * np.ones(model.nv))
    rows = [(float(gap[model.jnt_dofadr[j]]), c.name("joint", i, j)) for i, j in c.map.joints.items()]
    weights = model.body_invweight0 / column_scale(model.body_invweight0)
    rows += [
        (float(np.abs(weights[a] - weights[b]).max()), c.name("body", a, b))
        for a, b in c.map.bodies.items()
        if a and a not in c.matcher.carried
    ]
    for field in ("tendon_invweight0", "tendon_length0"):
        values = np.asarray(getattr(model, field))
        for t, image in c.action.tendons.items():
            sign = image.sign if field == "tendon_length0" else 1.0
            residual = abs(float(sign * values[t] - values[image.index])) / float(column_scale(values))
            rows.append((residual, c.name("tendon", t, image.index)))
    worst, name = max(rows, default=(0.0, ""))
    if kept:
        c.add("constraint weights", worst, name)
    elif worst > 1e-8:
        c.warnings.append(
            "qpos0 is not symmetric, and MuJoCo weighs constraints by it: limits and contacts of "
            f"{name} are {worst:.1%} softer or harder than their image's; make qpos0 symmetric (ref)"
        )
