"""Paths, ranges, springs and losses of tendons."""

from __future__ import annotations

from collections.abc import Iterable

from torchrl_sym.mujoco.audit.comparison import Comparison
from torchrl_sym.mujoco.audit.shapes import shape_residual
from torchrl_sym.mujoco.audit.sites import side_residual
from torchrl_sym.mujoco.model.types import mj


def compare_tendons(c: Comparison) -> None:
    """Paths, ranges, springs and losses."""
    model = c.model
    for t, image in c.action.tendons.items():
        u, sign, name = image.index, image.sign, c.name("tendon", t, image.index)
        first, count = int(model.tendon_adr[t]), int(model.tendon_num[t])
        shift = 0.0
        if model.wrap_type[first] == int(mj.mjtWrap.mjWRAP_JOINT):
            for k in range(first, first + count):
                joint = int(model.wrap_objid[k])
                factor = sign * c.map.signs[joint] * float(model.wrap_prm[k])
                shift += factor * c.map.offsets[joint]
        else:
            c.add("tendon path", path_residual(c, t, u), name)
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


def path_residual(c: Comparison, t: int, u: int) -> float:
    """Wraps, their sides and pulleys of spatial tendon t against those of u, in the better direction."""
    model = c.model
    a, b, count = int(model.tendon_adr[t]), int(model.tendon_adr[u]), int(model.tendon_num[t])

    def residual(order: Iterable[int]) -> float:
        worst = 0.0
        for k, m in enumerate(order):
            kind, objects = int(model.wrap_type[a + k]), model.wrap_objid[[a + k, b + m]]
            if kind != int(model.wrap_type[b + m]):
                return 1.0
            if kind in (int(mj.mjtWrap.mjWRAP_SPHERE), int(mj.mjtWrap.mjWRAP_CYLINDER)):
                shape = shape_residual(c, int(objects[0]), int(objects[1]))
                worst = max(worst, shape, side_residual(c, a + k, b + m))
            elif kind == int(mj.mjtWrap.mjWRAP_PULLEY):
                worst = max(worst, abs(float(model.wrap_prm[a + k] - model.wrap_prm[b + m])))
        return min(worst, 1.0)

    return min(residual(range(count)), residual(range(count - 1, -1, -1)))
