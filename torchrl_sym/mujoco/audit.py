"""Is a MuJoCo model really symmetric? Compare every physical term of each part with its image's.

`derive` finds where everything goes; it says nothing on whether the left leg weighs what the right one
does. `audit` does: for each element g of a group, the mass, inertia, axes, ranges, gains, shapes, ... of
every part are moved by g and compared with those of the part's image. What differs in unit is made
relative: masses to the total mass, lengths to the model's extent, ranges to their width, everything else
to the largest value in the model. A model is *exact* if nothing differs: its steps then commute with g to
rounding. It also warns of settings that make the solver itself break the symmetry.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup, check_group
from torchrl_sym.mujoco import geoms
from torchrl_sym.mujoco.derive import ModelSymmetry, derive
from torchrl_sym.mujoco.elements import Image
from torchrl_sym.mujoco.links import (
    BALL,
    FREE,
    HINGE,
    SLIDE,
    Array,
    MjModel,
    carried_bodies,
    check_model,
    links_of,
    mj,
    name_of,
)
from torchrl_sym.mujoco.report import AuditReport, Residual, phrase, simulation_warnings, unchecked_elements

# Beyond it, parts do not correspond. Public robots that are trained as symmetric stay below: 0.07 in the
# hip range of dm_control's humanoid, 0.04 in the inertias of ANYmal-C.
NOT_A_SYMMETRY = 0.1
_GAIN, _BIAS = mj.mjtGain, mj.mjtBias
_PLAIN_GAINS = (int(_GAIN.mjGAIN_FIXED), int(_GAIN.mjGAIN_AFFINE))
_PLAIN_BIASES = (int(_BIAS.mjBIAS_NONE), int(_BIAS.mjBIAS_AFFINE))


def audit(
    model: MjModel,
    group: PointGroup,
    keyframe: int | str | None = None,
    *,
    tolerance: float = 1e-8,
    carried: Sequence[str] = (),
) -> AuditReport:
    """How far each element of a group is from a symmetry of a model, term by term.

    Args:
        model: the compiled model.
        group: the group to try; it acts about the vertical axis through the world's origin.
        keyframe: a pose that the group keeps, by name or number. Defaults to ``qpos0``.
        tolerance: largest residual that counts as exact.
        carried: names of bodies that a turn of the world only carries along, as in
            :func:`~torchrl_sym.mujoco.derive`; their shape and inertia need no symmetry.

    Raises:
        KeyError: no such keyframe, or no such body to be carried.
        ValueError: a body that cannot be carried under any group.

    Example:
        >>> import mujoco
        >>> from torchrl_sym import PointGroup
        >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody>
        ...   <body name="left" pos="0 .1 0"><joint axis="1 0 0"/><geom size=".1" mass="1"/></body>
        ...   <body name="right" pos="0 -.1 0"><joint axis="1 0 0"/><geom size=".1" mass="1.02"/></body>
        ... </worldbody></mujoco>''')
        >>> audit(model, PointGroup.reflection("y")).verdict
        'approximate (largest residual 0.02: inertia, reflect-y, ...)'
    """
    # a mistake of the call is no finding about the model
    carried_bodies(check_model(model), carried)
    tolerance, group = checks.real("tolerance", tolerance, 0.0), check_group(group)
    elements = tuple(group.names[1:])
    warnings, unchecked = simulation_warnings(model, group), unchecked_elements(model)
    try:
        symmetry = derive(model, group, keyframe, carried=carried)
    except ValueError as error:  # SymmetryError, or a group that tilts gravity or does not close
        return AuditReport(elements, (), tolerance, str(error), warnings, unchecked)
    rows: list[Residual] = []
    loose: dict[str, None] = {}
    for g, name in enumerate(elements, start=1):
        run = _Element(symmetry, g)
        loose |= dict.fromkeys(run.compare())
        rows += [Residual(name, term, worst, part) for term, (worst, part) in run.worst.items()]
        unchecked += tuple(text for text in run.unchecked if text not in unchecked)
    if loose:
        shown = ", ".join(list(loose)[:4]) + ", ..." * (len(loose) > 4)
        text = f"{len(loose)} sites are out of place ({shown}); nothing in the model uses them, so do not"
        warnings += (f"{text} observe them",)
    report = AuditReport(elements, tuple(rows), tolerance, None, warnings, unchecked)
    if report.worst is None or report.worst.residual <= NOT_A_SYMMETRY:
        return report
    return AuditReport(elements, tuple(rows), tolerance, phrase(report.worst), warnings, unchecked)


class _Element:
    """Compares everything in a model with its image under one element; ``worst`` holds the outcome."""

    def __init__(self, symmetry: ModelSymmetry, g: int) -> None:
        self.model, self.action = symmetry.model, symmetry._actions[g]
        self.matcher = self.action.matcher
        self.data, self.image = self.matcher.data, self.matcher.image
        self.links = self.matcher.links
        self.image_links = links_of(self.model, self.image)
        self.map = self.action.coordinates
        self.worst: dict[str, tuple[float, str]] = {}
        self.unchecked: list[str] = []

    def add(self, term: str, residual: float, name: str) -> None:
        """Keep the worst part of each term."""
        if term not in self.worst or residual > self.worst[term][0]:
            self.worst[term] = (residual, name)

    def compare(self) -> list[str]:
        """Run all comparisons; returns the unused sites that are out of place."""
        self._links()
        self._joints()
        self._dofs()
        self._actuators()
        self._tendons()
        self._equalities()
        self._fluid()
        geoms.audit_geoms(self.model, self.data, self.matcher, self.map.bodies, self.add)
        return geoms.audit_sites(self.model, self.data, self.matcher, self.map.bodies, self.add)

    def _name(self, kind: str, a: int, b: int) -> str:
        name = name_of(self.model, kind, a)
        return name if a == b else f"{name} -> {name_of(self.model, kind, b)}"

    def _links(self) -> None:
        model, turn = self.model, self.matcher.matrix
        moving = [link for body, link in self.links.items() if body]  # the world's own mass does not matter
        total = max(sum(link.mass for link in moving), 1e-12)
        largest = max([float(np.abs(link.inertia).max()) for link in moving] + [1e-12])
        for a, b in self.map.bodies.items():
            if a == 0:
                continue
            one, other, name = self.links[a], self.image_links[b], self._name("body", a, b)
            self.add("mass", abs(one.mass - other.mass) / total, name)
            if min(one.mass, other.mass) > 0:
                offset = float(np.linalg.norm(turn @ one.com - other.com))
                self.add("centre of mass", offset / self.matcher.extent, name)
            image = turn @ one.inertia @ turn.T
            self.add("inertia", float(np.abs(image - other.inertia).max()) / largest, name)
            if model.body_gravcomp.any():
                lift = [model.body_mass[x.bodies] @ model.body_gravcomp[x.bodies] for x in (one, other)]
                self.add("gravity compensation", abs(float(lift[0] - lift[1])) / total, name)

    def _joints(self) -> None:
        model, data, turn = self.model, self.data, self.matcher.matrix  # no carried body has an axis
        rest = self.map.qpos @ model.qpos_spring + self.map.qpos_offset
        for i, j in self.map.joints.items():
            name, kind = self._name("joint", i, j), int(model.jnt_type[i])
            sign, shift = self.map.signs.get(i, 1.0), self.map.offsets.get(i, 0.0)
            gap = turn @ data.xanchor[i] - data.xanchor[j]
            if kind in (HINGE, SLIDE):
                axis = data.xaxis[j]
                self.add("joint axis", float(np.linalg.norm(np.cross(turn @ data.xaxis[i], axis))), name)
                gap = np.cross(gap, axis) if kind == HINGE else np.zeros(3)
            if kind != FREE:
                self.add("joint anchor", float(np.linalg.norm(gap)) / self.matcher.extent, name)
            self._range("joint range", "jnt_range", "jnt_limited", i, j, sign, shift, name)
            self._range("joint force range", "jnt_actfrcrange", "jnt_actfrclimited", i, j, sign, 0.0, name)
            same = np.flatnonzero(model.jnt_type == kind)
            self._fields("stiffness", ["jnt_stiffness"], i, j, name, same)
            self._fields("joint gravity compensation", ["jnt_actgravcomp"], i, j, name, same)
            if model.jnt_limited[i] or model.jnt_limited[j]:
                self._fields("joint solref/solimp", ["jnt_solref", "jnt_solimp", "jnt_margin"], i, j, name)
            if model.jnt_stiffness[i] > 0:
                start, size = int(model.jnt_qposadr[j]), {FREE: 7, BALL: 4}.get(kind, 1)
                one, other = rest[start : start + size], model.qpos_spring[start : start + size]
                if kind in (FREE, BALL):  # a quaternion and its negative are one rotation
                    one = np.concatenate([one[:-4], one[-4:] * np.sign(one[-4:] @ other[-4:] or 1.0)])
                scale = self.matcher.extent if kind == SLIDE else 1.0
                self.add("springref", float(np.abs(one - other).max()) / scale, name)

    def _dofs(self) -> None:
        """Damping, armature and friction loss: M diag(x) M^T = diag(x) with M the map of velocities."""
        model, turn = self.model, self.map.qvel
        joints = model.dof_jntid
        offset = np.arange(model.nv) - model.jnt_dofadr[joints]
        kinds = model.jnt_type[joints]
        linear = (kinds == SLIDE) | ((kinds == FREE) & (offset < 3))  # not in the units of turning dofs
        for term, field in (
            ("damping", "dof_damping"),
            ("armature", "dof_armature"),
            ("frictionloss", "dof_frictionloss"),
        ):
            values = getattr(model, field)
            if not values.any():
                continue
            scale = np.where(linear, *(geoms.column_scale(values[mask]) for mask in (linear, ~linear)))
            gap = np.abs(turn @ np.diag(values) @ turn.T - np.diag(values))
            gap = (gap / np.sqrt(np.outer(scale, scale))).max(axis=1, initial=0.0)
            for i, j in self.map.joints.items():
                start = int(model.jnt_dofadr[j])
                stop = start + {FREE: 6, BALL: 3}.get(int(model.jnt_type[j]), 1)
                self.add(term, float(gap[start:stop].max()), self._name("joint", i, j))
        for i, j in self.map.joints.items():
            a, b = int(model.jnt_dofadr[i]), int(model.jnt_dofadr[j])
            if model.dof_frictionloss[a] > 0:
                self._fields(
                    "joint solref/solimp", ["dof_solref", "dof_solimp"], a, b, self._name("joint", i, j)
                )

    def _actuators(self) -> None:
        model = self.model
        for a, image in self.action.actuators.items():
            b, sign, name = image.index, image.sign, self._name("actuator", a, image.index)
            kinds = ("gaintype", "biastype", "dyntype")
            same = all(
                getattr(model, f"actuator_{k}")[a] == getattr(model, f"actuator_{k}")[b] for k in kinds
            )
            self.add("actuator type", float(not same), name)
            if same:
                self._gains(a, image, name)
            self._fields(
                "actuator dynamics", ["actuator_dynprm", "actuator_actearly", "actuator_delay"], a, b, name
            )
            alike = np.flatnonzero(model.actuator_trntype == model.actuator_trntype[a])
            gears = np.linalg.norm(model.actuator_gear, axis=1, keepdims=True)
            self._values("gear", gears, a, b, name, alike)
            self._fields("actuator gain", ["actuator_lengthrange"], a, b, name, alike)
            self._fields("armature", ["actuator_armature"], a, b, name)
            self._fields("damping", ["actuator_damping"], a, b, name)
            for term, field, limited, shift in (
                ("ctrlrange", "actuator_ctrlrange", "actuator_ctrllimited", image.offset),
                ("forcerange", "actuator_forcerange", "actuator_forcelimited", 0.0),
                ("actrange", "actuator_actrange", "actuator_actlimited", image.offset),
            ):
                self._range(term, field, limited, a, b, sign, shift, name)

    def _gains(self, a: int, image: Image, name: str) -> None:
        """With u' = s u + o and length' = s length + o, the image's force must be s times the force."""
        model, b, sign, offset = self.model, image.index, image.sign, image.offset
        gain, bias = model.actuator_gainprm[a].copy(), model.actuator_biasprm[a].copy()
        kind = int(model.actuator_gaintype[a])
        if kind in _PLAIN_GAINS and int(model.actuator_biastype[a]) in _PLAIN_BIASES:
            if kind == _GAIN.mjGAIN_AFFINE:
                gain[1:3] *= sign
                gain[0] -= gain[1] * offset
            bias[0] = sign * bias[0] - (gain[0] + bias[1]) * offset
        elif sign < 0 and kind == _GAIN.mjGAIN_MUSCLE:
            self.add("actuator gain", 1.0, f"{name} (a muscle only pulls)")
        elif sign < 0:
            self.unchecked.append(f"gains of actuator {name_of(model, 'actuator', a)!r}, of a special kind")
        for term, field, image_prm in (
            ("actuator gain", model.actuator_gainprm, gain),
            ("actuator bias", model.actuator_biasprm, bias),
        ):
            self.add(term, float((np.abs(image_prm - field[b]) / geoms.column_scale(field)).max()), name)

    def _tendons(self) -> None:
        model = self.model
        for t, image in self.action.tendons.items():
            u, sign, name = image.index, image.sign, self._name("tendon", t, image.index)
            first, count = int(model.tendon_adr[t]), int(model.tendon_num[t])
            shift = 0.0
            if model.wrap_type[first] == int(mj.mjtWrap.mjWRAP_JOINT):
                for k in range(first, first + count):
                    joint = int(model.wrap_objid[k])
                    factor = sign * self.map.signs[joint] * float(model.wrap_prm[k])
                    shift += factor * self.map.offsets[joint]
            else:
                self.add("tendon path", geoms.path_residual(model, self.data, self.matcher, t, u), name)
            self._range("tendon range", "tendon_range", "tendon_limited", t, u, sign, shift, name)
            self._range("tendon range", "tendon_actfrcrange", "tendon_actfrclimited", t, u, sign, 0.0, name)
            if model.tendon_stiffness[t] > 0:
                self._range("tendon spring", "tendon_lengthspring", None, t, u, sign, shift, name)
            for term, fields in (
                ("tendon spring", ["stiffness"]),
                ("tendon damping", ["damping"]),
                ("tendon armature", ["armature"]),
                ("tendon frictionloss", ["frictionloss"]),
                (
                    "tendon solref/solimp",
                    ["solref_lim", "solimp_lim", "solref_fri", "solimp_fri", "margin"],
                ),
            ):
                self._fields(term, [f"tendon_{field}" for field in fields], t, u, name)

    def _equalities(self) -> None:
        model = self.model
        for e in range(model.neq):
            label = name_of(model, "equality", e)
            if int(model.eq_type[e]) not in geoms.EQUALITIES:
                self.unchecked.append(f"equality constraint {label!r}, of an unsupported kind")
                continue
            tendons = self.action.tendons
            fits = [
                (
                    geoms.equality_residual(model, self.data, self.matcher, self.map, tendons, e, f),
                    f != e,
                    f,
                )
                for f in range(model.neq)
            ]
            residual, _, f = min(fits)
            name = self._name("equality", e, f) if residual < 1 else f"{label} (no image)"
            self.add("equality constraints", residual, name)
            if residual < 1:
                self._fields("equality constraints", ["eq_solref", "eq_solimp", "eq_active0"], e, f, name)

    def _fluid(self) -> None:
        """Drag acts on each body's inertia box, so that its axes matter, and wind."""
        model, turn = self.model, self.matcher.matrix
        if not (model.opt.density > 0 or model.opt.viscosity > 0):
            return
        wind = model.opt.wind
        if wind.any():
            gap = float(np.linalg.norm(turn @ wind - wind) / np.linalg.norm(wind))
            self.add("wind", min(gap, 1.0), "wind")
        for a, b in self.map.bodies.items():
            one, other = ([x for x in self.links[k].bodies if model.body_mass[x] > 0] for k in (a, b))
            if a and len(one) == len(other) == 1:
                ends = ((self.data, one), (self.image, other))
                axes = [pose.ximat[body[0]].reshape(3, 3) for pose, body in ends]
                turned = axes[1].T @ turn @ axes[0]
                self.add("drag", float(np.abs(turned - turned.round()).max()), self._name("body", a, b))
            elif a and one:
                self.unchecked.append(f"drag on {name_of(model, 'body', a)!r}, a link of several bodies")

    def _range(
        self,
        term: str,
        field: str,
        limited: str | None,
        i: int,
        j: int,
        sign: float,
        shift: float,
        name: str,
    ) -> None:
        """An interval goes to ``sign * interval + shift``; compared relative to its width."""
        model = self.model
        flags = [bool(getattr(model, limited)[k]) if limited else True for k in (i, j)]
        if flags[0] != flags[1]:
            self.add(term, 1.0, f"{name} (only one is limited)")
        elif flags[0]:
            one, other = getattr(model, field)[i], getattr(model, field)[j]
            image = np.sort(sign * one + shift)
            scale = max(np.ptp(one), np.ptp(other)) or np.abs(other).max() or 1.0
            self.add(term, float(np.abs(image - other).max()) / scale, name)

    def _fields(
        self, term: str, fields: list[str], i: int, j: int, name: str, alike: NDArray[np.intp] | None = None
    ) -> None:
        """Model fields that must be equal, relative to the largest among elements of like units."""
        for field in fields:
            values = np.asarray(getattr(self.model, field), dtype=float)
            if not values.any():
                continue
            self._values(term, values.reshape(len(values), -1), i, j, name, alike)

    def _values(
        self, term: str, values: Array, i: int, j: int, name: str, alike: NDArray[np.intp] | None = None
    ) -> None:
        scale = geoms.column_scale(values if alike is None else values[alike])
        self.add(term, float((np.abs(values[i] - values[j]) / scale).max(initial=0.0)), name)
