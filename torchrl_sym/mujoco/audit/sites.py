"""Places of sites, those that something in the model uses apart from the others."""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.audit.geoms import Add, support_gap
from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.derive.sites import map_sites
from torchrl_sym.mujoco.model.shapes import support
from torchrl_sym.mujoco.model.types import Array, MjData, MjModel, mj, name_of

_OBJECT, _SENSOR = mj.mjtObj, mj.mjtSensor


def audit_sites(
    model: MjModel, data: MjData, matcher: Matcher, bodies: dict[int, int], add: Add
) -> list[str]:
    """Residuals of the sites that something uses; returns the names of other sites out of place."""

    def at(pose: MjData, site: int, directions: Array) -> Array:
        rotation, kind = pose.site_xmat[site].reshape(3, 3), int(model.site_type[site])
        return support(kind, model.site_size[site], pose.site_xpos[site], rotation, directions)

    images = map_sites(model, data, matcher, bodies, np.inf)
    used, loose = _used_sites(model), []
    touch = set(model.sensor_objid[model.sensor_type == int(_SENSOR.mjSENS_TOUCH)].tolist())
    for a in range(model.nsite):
        b = images.get(a)
        if b is None:
            residual, name = 1.0, f"{name_of(model, 'site', a)} (no image)"
        else:
            turned = matcher.matrix @ data.site_xpos[a]
            residual = float(np.linalg.norm(turned - matcher.image.site_xpos[b])) / matcher.extent
            name = name_of(model, "site", a)
            name += f" -> {name_of(model, 'site', b)}" if a != b else ""
            if a in touch:  # such a sensor feels the contacts inside the site
                residual = max(residual, support_gap(matcher, at, a, b))
        if a in used:
            add("sites", residual, name)
        elif residual > 1e-6:
            loose.append(name)
    return loose


def _used_sites(model: MjModel) -> set[int]:
    """Sites that a sensor, actuator, tendon or equality constraint refers to."""
    kind = int(_OBJECT.mjOBJ_SITE)
    by_site = model.actuator_trntype == int(mj.mjtTrn.mjTRN_SITE)
    groups = (
        model.actuator_trnid[by_site].ravel(),
        model.wrap_objid[model.wrap_type == int(mj.mjtWrap.mjWRAP_SITE)],
        model.sensor_objid[model.sensor_objtype == kind],
        model.sensor_refid[model.sensor_reftype == kind],
        model.eq_obj1id[model.eq_objtype == kind],
        model.eq_obj2id[model.eq_objtype == kind],
    )
    return {int(site) for group in groups for site in group if site >= 0}
