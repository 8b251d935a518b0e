"""Gains, biases, dynamics and ranges of actuators."""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.audit.comparison import Comparison, column_scale
from torchrl_sym.mujoco.audit.shapes import DISCRETE
from torchrl_sym.mujoco.derive.images import Image
from torchrl_sym.mujoco.model.types import mj, name_of

_GAIN, _BIAS = mj.mjtGain, mj.mjtBias
_PLAIN_GAINS = (int(_GAIN.mjGAIN_FIXED), int(_GAIN.mjGAIN_AFFINE))
_PLAIN_BIASES = (int(_BIAS.mjBIAS_NONE), int(_BIAS.mjBIAS_AFFINE))
_MUSCLES = int(_GAIN.mjGAIN_MUSCLE), int(_BIAS.mjBIAS_MUSCLE), int(mj.mjtDyn.mjDYN_MUSCLE)
_LINEAR = [int(getattr(mj.mjtDyn, f"mjDYN_{n}")) for n in ("NONE", "INTEGRATOR", "FILTER", "FILTEREXACT")]


def compare_actuators(c: Comparison) -> None:
    """Types, gains, gears, ranges and losses."""
    model = c.model
    for a, reason in c.action.refusals.items():
        c.untold.append(f"actuator {name_of(model, 'actuator', a)!r}: {reason}")
    for a, image in c.action.actuators.items():
        b, sign, name = image.index, image.sign, c.name("actuator", a, image.index)
        c.add("transmission", image.misfit, name)
        if image.through:  # a constraint gives way a little
            c.add("transmission", DISCRETE, f"{name} (through equality {image.through})")
        kinds = ("gaintype", "biastype", "dyntype")
        same = all(getattr(model, f"actuator_{k}")[a] == getattr(model, f"actuator_{k}")[b] for k in kinds)
        c.add("actuator type", float(not same), name)
        if same:
            _gains(c, a, image, name)
        c.fields(
            "actuator dynamics", ["actuator_dynprm", "actuator_actearly", "actuator_delay"], a, b, name
        )
        alike = np.flatnonzero(model.actuator_trntype == model.actuator_trntype[a])
        gears = np.linalg.norm(model.actuator_gear, axis=1, keepdims=True)
        c.values("gear", gears, a, b, name, alike)
        kinds = (model.actuator_gaintype[a], model.actuator_biastype[a], model.actuator_dyntype[a])
        if any(
            kind == muscle for kind, muscle in zip(kinds, _MUSCLES, strict=True)
        ):  # nothing else asks it
            c.fields("actuator gain", ["actuator_lengthrange"], a, b, name, alike)
        c.fields("armature", ["actuator_armature"], a, b, name)
        c.fields("damping", ["actuator_damping", "actuator_dampingpoly"], a, b, name)
        control = image.control_sign
        for term, field, limited, turn, shift in (
            ("ctrlrange", "actuator_ctrlrange", "actuator_ctrllimited", control, image.offset),
            ("forcerange", "actuator_forcerange", "actuator_forcelimited", sign, 0.0),
            ("actrange", "actuator_actrange", "actuator_actlimited", control, image.state_offset),
        ):
            if not image.mixture:
                c.range(term, field, limited, a, b, turn, shift, name)
            elif getattr(model, limited)[a]:
                c.add(term, 1.0, f"{name} (a box, which the element turns)")


def _gains(c: Comparison, a: int, image: Image, name: str) -> None:
    """With u' = s u + o and length' = s length + o, the image's force must be s times the force."""
    model, b, sign, offset = c.model, image.index, image.sign, image.offset
    gain, bias = model.actuator_gainprm[a].copy(), model.actuator_biasprm[a].copy()
    kind = int(model.actuator_gaintype[a])
    linear = kind == _GAIN.mjGAIN_FIXED and int(model.actuator_biastype[a]) in _PLAIN_BIASES
    linear &= not np.any(getattr(model, "actuator_dampingpoly", np.zeros((model.nu, 1)))[a])
    if image.mixture and not (linear and int(model.actuator_dyntype[a]) in _LINEAR):
        c.add("actuator gain", 1.0, f"{name} (forces that are not linear, which the element turns)")
    if kind in _PLAIN_GAINS and int(model.actuator_biastype[a]) in _PLAIN_BIASES:
        if kind == _GAIN.mjGAIN_AFFINE:
            gain[0] *= sign * image.control_sign
            gain[1:3] *= image.control_sign
            gain[0] -= gain[1] * (image.length_offset if image.keeps else offset)
        constant = sign * bias[0]
        if image.mixture:
            others = c.action.actuators.items()
            constant = sum(x.weights.get(b, 0.0) * model.actuator_biasprm[k, 0] for k, x in others)
        bias[0] = constant - (gain[0] + bias[1]) * offset
    elif sign < 0 and kind == _GAIN.mjGAIN_MUSCLE:
        c.add("actuator gain", 1.0, f"{name} (a muscle only pulls)")
    elif sign < 0:
        c.unchecked.append(f"gains of actuator {name_of(model, 'actuator', a)!r}, of a special kind")
    for term, field, image_prm in (
        ("actuator gain", model.actuator_gainprm, gain),
        ("actuator bias", model.actuator_biasprm, bias),
    ):
        c.add(term, float((np.abs(image_prm - field[b]) / column_scale(field)).max()), name)
