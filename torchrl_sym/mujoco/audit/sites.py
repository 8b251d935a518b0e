"""Places of sites, judged by what uses them.

Those that actuators, tendons and constraints act at are compared with these. Sites that sensors read belong
to the observation: a robot whose accelerometer sits beside the middle plane moves symmetrically. A gyro
reads the same wherever it sits on its link.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from torchrl_sym.mujoco.audit.comparison import Comparison
from torchrl_sym.mujoco.derive.sites import map_sites
from torchrl_sym.mujoco.model.shapes import DIRECTIONS, supports
from torchrl_sym.mujoco.model.types import Array, MjData, MjModel, mj, name_of

_OBJECT, _SENSOR, _WRAP = mj.mjtObj, mj.mjtSensor, mj.mjtWrap
_SITE = int(_OBJECT.mjOBJ_SITE)
_ANYWHERE = [  # sensors that read the same at every place of a link
    int(kind)
    for kind in (
        _SENSOR.mjSENS_GYRO,
        _SENSOR.mjSENS_MAGNETOMETER,
        _SENSOR.mjSENS_FORCE,
        _SENSOR.mjSENS_FRAMEQUAT,
        _SENSOR.mjSENS_FRAMEXAXIS,
        _SENSOR.mjSENS_FRAMEYAXIS,
        _SENSOR.mjSENS_FRAMEZAXIS,
        _SENSOR.mjSENS_FRAMEANGVEL,
        _SENSOR.mjSENS_FRAMEANGACC,
    )
]
_VOLUME = [  # sensors of what is inside a site
    int(getattr(_SENSOR, name))
    for name in ("mjSENS_TOUCH", "mjSENS_INSIDESITE", "mjSENS_CONTACT")
    if hasattr(_SENSOR, name)  # which older versions lack
]
_ROUND = (int(_WRAP.mjWRAP_SPHERE), int(_WRAP.mjWRAP_CYLINDER))


def compare_sites(c: Comparison) -> list[str]:
    """Residuals of the sites that something uses; returns the names of unused ones out of place."""
    model, turn, loose = c.model, c.matcher.matrix, []
    images = map_sites(model, c.data, c.matcher, c.map.bodies, np.inf)
    acting, read, placeless = _acting(model), _read(model), _placeless(model)
    volumes = _of_sensors(model, np.isin(model.sensor_type, _VOLUME))
    for a in range(model.nsite):
        b = images.get(a)
        if b is None:
            residual, name = 1.0, f"{name_of(model, 'site', a)} (no image)"
        else:
            gap = turn @ c.data.site_xpos[a] - c.image.site_xpos[b]
            residual, name = float(np.linalg.norm(gap)) / c.matcher.extent, c.name("site", a, b)
            if a in volumes:
                one = _support(model, c.data, a, DIRECTIONS @ turn)
                size = np.abs(one - _support(model, c.image, b, DIRECTIONS)).max()
                residual = max(residual, float(size) / c.matcher.extent)
        if a in acting and b is not None:
            lengths = np.linalg.norm(model.site_quat[[a, b]], axis=1)
            c.add("site rotation", abs(float(lengths[0] - lengths[1])), name)
        if a in read:
            c.add("sensor sites", min(residual, 1.0), name, kind="observation")
        elif residual > 1e-6 and a not in placeless | acting:
            loose.append(name)
    return loose


def _support(model: MjModel, pose: MjData, site: int, directions: Array) -> Array:
    frame = pose.site_xmat[site].reshape(1, 3, 3)
    return supports(
        int(model.site_type[site]), model.site_size[[site]], pose.site_xpos[[site]], frame, directions
    )[0]


def _acting(model: MjModel) -> set[int]:
    """Sites at which an actuator, a tendon or an equality constraint acts."""
    by_site = model.actuator_trntype == int(mj.mjtTrn.mjTRN_SITE)
    slider = model.actuator_trntype == int(mj.mjtTrn.mjTRN_SLIDERCRANK)
    return _numbers(
        model.actuator_trnid[by_site | slider].ravel(),
        model.wrap_objid[model.wrap_type == int(_WRAP.mjWRAP_SITE)],
        model.eq_obj1id[model.eq_objtype == _SITE],
        model.eq_obj2id[model.eq_objtype == _SITE],
    )


def _read(model: MjModel) -> set[int]:
    """Sites whose place a sensor's reading depends on."""
    depends = ~np.isin(model.sensor_type, _ANYWHERE)
    return _of_sensors(model, depends)


def _placeless(model: MjModel) -> set[int]:
    """Other sites that are used, wherever they are: by gyros, and to say on which side a tendon passes."""
    sides = model.wrap_prm[np.isin(model.wrap_type, _ROUND)]
    return _of_sensors(model, np.isin(model.sensor_type, _ANYWHERE)) | _numbers(sides)


def _of_sensors(model: MjModel, some: NDArray[np.bool_]) -> set[int]:
    return _numbers(
        model.sensor_objid[some & (model.sensor_objtype == _SITE)],
        model.sensor_refid[some & (model.sensor_reftype == _SITE)],
    )


def _numbers(*groups: Iterable[float]) -> set[int]:
    return {int(site) for group in groups for site in group if site >= 0}
