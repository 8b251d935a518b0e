"""Paths, ranges, springs and losses of tendons."""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.audit.comparison import Comparison
from torchrl_sym.mujoco.derive.lengths import tendon_length
from torchrl_sym.mujoco.model.types import Array, MjModel, mj

_LOSSES = {
    "tendon spring": "stiffness",
    "tendon damping": "damping",
    "tendon armature": "armature",
    "tendon frictionloss": "frictionloss",
}


def _not_linear(model: MjModel) -> list[Array]:
    """Numbers of tendons that make a force which is not linear in lengths and velocities."""
    slack = np.ptp(model.tendon_lengthspring, axis=1) * (model.tendon_stiffness > 0)
    fields = ("frictionloss", "stiffnesspoly", "dampingpoly")
    values = [np.asarray(getattr(model, f"tendon_{f}", np.zeros(model.ntendon))) for f in fields]
    return [slack, *values]


def compare_tendons(c: Comparison) -> None:
    """Paths, coefficients, ranges, springs and losses."""
    model = c.model
    lengths = np.zeros((model.ntendon, model.nv))
    for t in range(model.ntendon):
        lengths[t] = tendon_length(model, t)[: model.nv]
    losses = {field: np.array(getattr(model, f"tendon_{field}")) for field in _LOSSES.values()}
    scales = {field: c.efforts.tendon_scale(field, values, lengths) for field, values in losses.items()}
    for t, image in c.action.tendons.items():
        u, sign, name = image.index, image.sign, c.name("tendon", t, image.index)
        fixed = model.wrap_type[int(model.tendon_adr[t])] == int(mj.mjtWrap.mjWRAP_JOINT)
        c.add("tendon coefficients" if fixed else "tendon path", image.misfit, name)
        shift = image.offset
        if image.mixture:
            if model.tendon_limited[t] or model.tendon_actfrclimited[t]:
                c.add("tendon range", 1.0, f"{name} (a box, which the element turns)")
            others = c.action.tendons.items()
            rest = sum(x.weights.get(u, 0.0) * model.tendon_lengthspring[k, 0] for k, x in others) + shift
            gap = abs(float(rest - model.tendon_lengthspring[u, 0])) * (model.tendon_stiffness[t] > 0)
            c.add("tendon spring", gap / c.matcher.extent, name)
            if any(model_field[t].any() for model_field in _not_linear(model)):
                c.add("tendon spring", 1.0, f"{name} (forces that are not linear, which the element turns)")
        else:
            c.range("tendon range", "tendon_range", "tendon_limited", t, u, sign, shift, name)
            c.range("tendon range", "tendon_actfrcrange", "tendon_actfrclimited", t, u, sign, 0.0, name)
        if model.tendon_stiffness[t] > 0 and not image.mixture:
            c.range("tendon spring", "tendon_lengthspring", None, t, u, sign, shift, name)
        for term, field in _LOSSES.items():
            apart = abs(losses[field][t] - losses[field][u])
            c.add(term, float(apart / scales[field][[t, u]].min()), name)
        for term, fields in (
            ("tendon spring", ["stiffnesspoly"]),
            ("tendon damping", ["dampingpoly"]),
            (
                "tendon solref/solimp",
                ["solref_lim", "solimp_lim", "solref_fri", "solimp_fri", "margin"],
            ),
        ):
            c.fields(term, [f"tendon_{field}" for field in fields], t, u, name)
