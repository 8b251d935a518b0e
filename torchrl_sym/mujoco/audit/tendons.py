"""Paths, ranges, springs and losses of tendons."""

from __future__ import annotations

from torchrl_sym.mujoco.audit.comparison import Comparison
from torchrl_sym.mujoco.model.types import mj


def compare_tendons(c: Comparison) -> None:
    """Paths, coefficients, ranges, springs and losses."""
    model = c.model
    for t, image in c.action.tendons.items():
        u, sign, name = image.index, image.sign, c.name("tendon", t, image.index)
        fixed = model.wrap_type[int(model.tendon_adr[t])] == int(mj.mjtWrap.mjWRAP_JOINT)
        c.add("tendon coefficients" if fixed else "tendon path", image.misfit, name)
        shift = image.offset
        if image.mixture:
            if model.tendon_limited[t] or model.tendon_actfrclimited[t]:
                c.add("tendon range", 1.0, f"{name} (a box, which the element turns)")
            continue
        c.range("tendon range", "tendon_range", "tendon_limited", t, u, sign, shift, name)
        c.range("tendon range", "tendon_actfrcrange", "tendon_actfrclimited", t, u, sign, 0.0, name)
        if model.tendon_stiffness[t] > 0:
            c.range("tendon spring", "tendon_lengthspring", None, t, u, sign, shift, name)
        for term, fields in (
            ("tendon spring", ["stiffness", "stiffnesspoly"]),
            ("tendon damping", ["damping", "dampingpoly"]),
            ("tendon armature", ["armature"]),
            ("tendon frictionloss", ["frictionloss"]),
            (
                "tendon solref/solimp",
                ["solref_lim", "solimp_lim", "solref_fri", "solimp_fri", "margin"],
            ),
        ):
            c.fields(term, [f"tendon_{field}" for field in fields], t, u, name)
