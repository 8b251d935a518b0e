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
        c.fields("actuator gain", ["actuator_lengthrange"], a, b, name, alike)
        c.fields("armature", ["actuator_armature"], a, b, name)
        c.fields("damping", ["actuator_damping"], a, b, name)
        for term, field, limited, shift in (
            ("ctrlrange", "actuator_ctrlrange", "actuator_ctrllimited", image.offset),
            ("forcerange", "actuator_forcerange", "actuator_forcelimited", 0.0),
            ("actrange", "actuator_actrange", "actuator_actlimited", image.state_offset),
        ):
            if not image.mixture:
                c.range(term, field, limited, a, b, sign, shift, name)
            elif getattr(model, limited)[a]:
                c.add(term, 1.0, f"{name} (a box, which the element turns)")


def _gains(c: Comparison, a: int, image: Image, name: str) -> None:
    """With u' = s u + o and length' = s length + o, the image's force must be s times the force."""
    model, b, sign, offset = c.model, image.index, image.sign, image.offset
    gain, bias = model.actuator_gainprm[a].copy(), model.actuator_biasprm[a].copy()
    kind = int(model.actuator_gaintype[a])
    if kind in _PLAIN_GAINS and int(model.actuator_biastype[a]) in _PLAIN_BIASES:
        if kind == _GAIN.mjGAIN_AFFINE:
            gain[1:3] *= sign
            gain[0] -= gain[1] * offset
        bias[0] = sign * bias[0] - (gain[0] + bias[1]) * offset
    elif sign < 0 and kind == _GAIN.mjGAIN_MUSCLE:
        c.add("actuator gain", 1.0, f"{name} (a muscle only pulls)")
    elif sign < 0:
        c.unchecked.append(f"gains of actuator {name_of(model, 'actuator', a)!r}, of a special kind")
    for term, field, image_prm in (
        ("actuator gain", model.actuator_gainprm, gain),
        ("actuator bias", model.actuator_biasprm, bias),
    ):
        c.add(term, float((np.abs(image_prm - field[b]) / column_scale(field)).max()), name)
