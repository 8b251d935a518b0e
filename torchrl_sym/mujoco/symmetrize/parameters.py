"""Averages of the parameters of joints and actuators."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from torchrl_sym.mujoco.model.types import HINGE, Array, mj, name_of
from torchrl_sym.mujoco.symmetrize.averager import Averager, Maps

Move: TypeAlias = Callable[[int, int], tuple[float, float]]  # sign and offset
_SCALAR = tuple(
    int(t) for t in (mj.mjtTrn.mjTRN_JOINT, mj.mjtTrn.mjTRN_JOINTINPARENT, mj.mjtTrn.mjTRN_TENDON)
)
_JOINT_FIELDS = {"margin": "jnt_margin", "solref_limit": "jnt_solref", "solimp_limit": "jnt_solimp"}
_DOF_FIELDS = {
    "armature": "dof_armature",
    "frictionloss": "dof_frictionloss",
    "solref_friction": "dof_solref",
    "solimp_friction": "dof_solimp",
}


def average_joints(averager: Averager) -> None:
    """Ranges, springs, losses and constraint parameters of joints."""
    model, dofs = averager.model, averager.model.jnt_dofadr
    maps = [action.coordinates.joints for action in averager.actions]
    fields = {name: getattr(model, at) for name, at in _JOINT_FIELDS.items()}
    fields |= {name: getattr(model, at)[dofs] for name, at in _DOF_FIELDS.items()}
    fields["damping"] = _polynomial(model, "dof_damping")[dofs]
    fields["stiffness"] = _polynomial(model, "jnt_stiffness")
    average_unsigned(averager, maps, "joint", fields)
    on_line = [
        {a: b for a, b in m.items() if a in action.coordinates.signs}
        for m, action in zip(maps, averager.actions, strict=True)
    ]

    def affine(g: int, a: int) -> tuple[float, float]:
        return averager.actions[g].coordinates.signs[a], averager.actions[g].coordinates.offsets[a]

    def linear(g: int, a: int) -> tuple[float, float]:
        return averager.actions[g].coordinates.signs[a], 0.0

    springs = model.qpos_spring[model.jnt_qposadr][:, None]
    _signed(averager, on_line, "joint", "range", model.jnt_range, model.jnt_limited, affine)
    _signed(averager, on_line, "joint", "springref", springs, None, affine)
    limits, on = model.jnt_actfrcrange, model.jnt_actfrclimited
    _signed(averager, on_line, "joint", "actfrcrange", limits, on, linear)


def average_actuators(averager: Averager) -> None:
    """With force f = g u + b0 + b1 l + b2 v, only b0 has a sign and an offset."""
    model = averager.model
    maps = [{a: image.index for a, image in action.actuators.items()} for action in averager.actions]
    gears, biases = np.array(model.actuator_gear), np.array(model.actuator_biasprm)
    gains = averager.mean(maps, lambda _, a: model.actuator_gainprm[a])
    slopes = averager.mean(maps, lambda _, a: biases[a])
    for b, size in averager.mean(maps, lambda _, a: abs(gears[a, 0])).items():
        kind = int(model.actuator_trntype[b])
        if kind in _SCALAR:
            gears[b, 0] = np.copysign(size, gears[b, 0])
            name = name_of(model, "actuator", b)
            averager.write(
                averager.spec.actuators[b], "gear", gears[b], model.actuator_gear[b], "actuator gear", name
            )

    def lengths(g: int, a: int) -> float:
        """Offset of an actuator's length, from that of its joint."""
        on_joint = int(model.actuator_trntype[a]) in _SCALAR[:2]
        joint = int(model.actuator_trnid[a, 0]) if on_joint else -1
        return float(averager.actions[g].coordinates.offsets.get(joint, 0.0) * gears[maps[g][a], 0])

    def control(g: int, a: int) -> tuple[float, float]:
        image = averager.actions[g].actuators[a]
        return image.control_sign, lengths(g, a) * (image.offset != 0)

    def state(g: int, a: int) -> tuple[float, float]:
        return averager.actions[g].actuators[a].control_sign, 0.0

    def force(g: int, a: int) -> tuple[float, float]:
        return averager.actions[g].actuators[a].sign, 0.0

    def bias(g: int, a: int) -> Array:
        (_, offset), (sign, _), b, out = control(g, a), force(g, a), maps[g][a], biases[a].copy()
        if model.actuator_biastype[a] == int(mj.mjtBias.mjBIAS_AFFINE):
            out[0] = sign * out[0] - gains[b][0] * offset - slopes[b][1] * lengths(g, a)
        return out

    for b, mean in averager.mean(maps, bias).items():
        name = name_of(model, "actuator", b)
        averager.write(averager.spec.actuators[b], "biasprm", mean, biases[b], "actuator biasprm", name)
    average_unsigned(
        averager, maps, "actuator", {n: getattr(model, f"actuator_{n}") for n in ("gainprm", "dynprm")}
    )
    for name, move in (("ctrl", control), ("force", force), ("act", state)):
        values, on = (getattr(model, f"actuator_{name}{what}") for what in ("range", "limited"))
        _signed(averager, maps, "actuator", f"{name}range", values, on, move)


def average_unsigned(averager: Averager, maps: Maps, kind: str, fields: dict[str, Array]) -> None:
    """Average parameters that move with their element without a sign."""
    for name, values in fields.items():
        for b, mean in averager.mean(maps, lambda _, a, v=values: v[a]).items():
            element = getattr(averager.spec, f"{kind}s")[b]
            many = np.ndim(getattr(element, name)) > 0 or np.ndim(mean) == 0
            new, old = (mean, values[b]) if many else (mean[0], values[b][0])
            written = averager.write(
                element, name, new, old, f"{kind} {name}", name_of(averager.model, kind, b)
            )
            if written and name in ("damping", "stiffness") and kind == "joint":
                element.springdamper = [0.0, 0.0]


def _signed(
    averager: Averager, maps: Maps, kind: str, attribute: str, values: Array, limited: Any, move: Move
) -> None:
    """Average intervals (or numbers) that move(g, a) flips by a sign and shifts by an offset."""

    def image(g: int, a: int) -> Array:
        sign, offset = move(g, a)
        return np.sort(sign * values[a] + offset)

    for b, mean in averager.mean(maps, image).items():
        element, name = getattr(averager.spec, f"{kind}s")[b], name_of(averager.model, kind, b)
        on = {bool(limited[m[b]]) for m in maps} if limited is not None else {True}
        if len(on) > 1:
            averager.report.left.append(f"{attribute} of {kind} {name!r}: not limited for all its images")
        angle = kind == "joint" and averager.model.jnt_type[b] == HINGE and attribute != "actfrcrange"
        unit = 180 / np.pi if angle and element.compiler.degree else 1.0
        if on == {True} and averager.write(
            None, "", mean, values[b], f"{kind} {attribute}", name, 1.0 if angle else 0.0
        ):
            value = (mean * unit).tolist()
            setattr(element, attribute, value if len(value) > 1 else value[0])
            if kind == "actuator":
                element.inheritrange = 0.0


def _polynomial(model: Any, name: str) -> Array:
    """Coefficients of a damping or stiffness."""
    return np.column_stack([getattr(model, name), getattr(model, f"{name}poly")])
